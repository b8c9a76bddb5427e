# make demo   install into .venv, fly every tracking baseline on the helix and write a page of it (needs Python and pip)
# make test   install the development extras and run ruff, mypy and the tests
# make slow   the tests that take longer: dissertation tables, other solvers, long flights
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check -q

.PHONY: demo test slow clean

demo: $(VENV)/installed
	$(BIN)/quad-envs benchmark quick --fresh --out runs/demo
	@echo "Open this page in a browser: $(CURDIR)/runs/demo/report.html"

test: $(VENV)/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest

slow: $(VENV)/installed-dev
	$(BIN)/python -m pytest -m slow

$(VENV)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) install -c constraints.txt -e .
	touch $@

$(VENV)/installed-dev: $(VENV)/installed
	$(PIP) install -c constraints.txt torch
	$(PIP) install -c constraints.txt -e ".[dev]"
	touch $@

clean:
	rm -rf $(VENV) build *.egg-info
