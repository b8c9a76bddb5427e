# make demo   install into .venv, fly every tracking baseline on the helix and write a page of it (needs Python and pip)
# make test   install the development extras and run ruff, mypy and the tests
# make slow   the tests that take longer: dissertation tables, other solvers, long flights
# make trust  try to break things for an hour, and say what was tried and what failed
# make wheel  build a wheel into dist/ whose kernels are compiled: no wait at the first use (x86-64)
# make sdist  build the source distribution into dist/: packages, tests and documentation
# make check-release  both; install the wheel into a new environment far from here, and run all quick tests there
#                     (TESTS="tests/test_spec.py" runs some)
# make test-matrix  the quick tests on every Python that is supported, found as python3.X, and on the lowest versions
#                   of all dependencies (VERSIONS="3.10 lowest" runs some, TESTS="..." some tests)
# make docs   build the documentation into site/
# make extras resolve every extra with the pins of constraints.txt, and install nothing
# make rllib  install RLlib into .venv-rllib (it pins an older gymnasium) and train a formation on a local Ray
# make test-rllib  conformance with that gymnasium, and the example, in that environment
# make ray    fly the quick benchmark on joblib's Ray backend, in the same environment
PYTHON ?= python3
TESTS ?=
VENV ?= .venv
RLLIB ?= .venv-rllib
BIN := $(VENV)/bin
RLLIB_PIP := $(RLLIB)/bin/python -m pip --disable-pip-version-check -q install -c examples/constraints-rllib.txt
PIP := $(BIN)/python -m pip --disable-pip-version-check -q

EXTRAS := $(shell sed -n '/optional-dependencies/,/^\[project.scripts/s/^\([a-z]*\) = .*/\1/p' pyproject.toml)

.PHONY: demo test slow trust test-matrix wheel sdist check-release docs extras rllib test-rllib ray clean

demo:
	@test -e $(VENV)/installed || echo "install: into $(VENV), one to three minutes; then compile, about one, and fly"
	@$(MAKE) -s --no-print-directory PIP="$(BIN)/python -m pip --disable-pip-version-check" $(VENV)/installed
	@$(BIN)/quad-envs benchmark quick --fresh --out runs/demo
	@echo "Open this page in a browser: $(CURDIR)/runs/demo/report.html"

test: $(VENV)/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest

slow: $(VENV)/installed-dev
	$(BIN)/python -m pytest -m slow

trust: $(VENV)/installed-dev
	$(BIN)/python -m benchmarks.trust --seconds 600

test-matrix:
	.ci/test-matrix $(TESTS)

wheel: $(VENV)/installed
	rm -rf build quad_envs/kernels dist/quad_envs-*.whl
	$(BIN)/quad-envs warm --portable build/portable
	mkdir -p quad_envs/kernels build/portable/quad-envs
	cp build/portable/quad-envs/*.nbc quad_envs/kernels || true
	$(PIP) wheel --no-deps -w dist . ; status=$$?; rm -rf quad_envs/kernels; exit $$status
	@ls -sh dist/quad_envs-*.whl

sdist: $(VENV)/installed
	$(PIP) install -c constraints.txt build
	rm -f dist/quad_envs-*.tar.gz
	$(BIN)/python -m build --sdist --outdir dist .

check-release: wheel sdist
	.ci/check-release $(PYTHON) $(TESTS)

docs: $(VENV)/installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict
	@echo "Open this page in a browser: $(CURDIR)/site/index.html"

extras: $(VENV)/installed
	for extra in $(EXTRAS); do echo "$$extra" && $(PIP) install --dry-run -c constraints.txt -e ".[$$extra]" || exit 1; done

rllib: $(RLLIB)/installed
	$(RLLIB)/bin/python -m examples.rllib_formation

test-rllib: $(RLLIB)/installed
	$(RLLIB)/bin/python -m pytest -m "slow or not slow" tests/test_registry.py tests/test_examples.py

ray: $(RLLIB)/installed
	$(RLLIB)/bin/quad-envs benchmark quick --engine ray --jobs 2 --fresh --out runs/ray

$(RLLIB)/installed: pyproject.toml constraints.txt examples/constraints-rllib.txt
	$(PYTHON) -m venv $(RLLIB)
	$(RLLIB_PIP) torch
	$(RLLIB_PIP) -e . "ray[rllib]" pytest
	touch $@

$(VENV)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) install -c constraints.txt -e .
	touch $@

$(VENV)/installed-dev: $(VENV)/installed
	$(PIP) install -c constraints.txt torch
	$(PIP) install -c constraints.txt -e ".[dev]"
	touch $@

$(VENV)/installed-docs: $(VENV)/installed
	$(PIP) install -c constraints.txt -e ".[docs]"
	touch $@

clean:
	rm -rf $(VENV) $(RLLIB) .venv-matrix site build *.egg-info
