# Each target makes its own environment in .venv when there is none.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
CORE := $(VENV)/.core
FULL := $(VENV)/.full

.PHONY: demo study test test-slow bench lint clean

$(CORE): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e .
	touch $@

$(FULL): $(CORE)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e ".[dev,evaluate,cluster,geff]"
	touch $@

demo: $(CORE)
	$(BIN)/cellquant demo -o demo

study: $(CORE)
	$(BIN)/python examples/hela_study/study.py -o study

test: $(FULL)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -n 2 --dist loadfile

test-slow: $(FULL)
	$(BIN)/python -m pytest -m slow --timeout 3600

bench: $(FULL)
	$(BIN)/python benchmarks/run_all.py

lint: $(FULL)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) demo study dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
