# Every target makes its own virtual environment; only python3, make and g++ are assumed.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SOURCES := $(shell find src core -type f \( -name '*.py' -o -name '*.hpp' -o -name '*.cpp' \)) CMakeLists.txt pyproject.toml

.PHONY: help demo test check bench docs sanitize clean
help:
	@echo "make demo | test | check | bench | docs | sanitize | clean"

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip

# One stamp per set of extras: reinstalls when a source changes.
$(VENV)/.installed-%: $(BIN)/python $(SOURCES)
	$(BIN)/python -m pip install --quiet ".[$*]"
	@touch $@

demo: $(VENV)/.installed-app
	$(BIN)/halfwidth demo

test: $(VENV)/.installed-test,dev
	$(BIN)/python -m pytest -n 2 --dist loadgroup tests

check: $(VENV)/.installed-test,dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(VENV)/.installed-bench
	$(BIN)/python benchmarks/speed.py

docs: $(VENV)/.installed-docs
	$(BIN)/mkdocs build --strict

sanitize: $(BIN)/python
	$(BIN)/python tests/core/sanitize.py

clean:
	rm -rf $(VENV) build site out
