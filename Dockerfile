# docker build -t quad-envs .
# docker run --rm quad-envs evaluate quad/HelixTracking-v0 nmpc
# docker run --rm -v "$PWD/runs:/home/pilot/runs" quad-envs benchmark quick --out runs/quick
# The first stage compiles the kernels into a wheel, the second installs nothing but that wheel and the pins.
FROM python:3.12-slim AS build
RUN apt-get update \
    && apt-get install --yes --no-install-recommends make \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /src
COPY . .
RUN make wheel PYTHON=python

FROM python:3.12-slim
RUN --mount=type=bind,from=build,source=/src,target=/src \
    pip install --no-cache-dir -c /src/constraints.txt /src/dist/*.whl \
    && useradd --create-home pilot
USER pilot
WORKDIR /home/pilot
ENTRYPOINT ["quad-envs"]
CMD ["--help"]
