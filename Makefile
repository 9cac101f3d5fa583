# make demo, make test, make test-all, make lint, make bench: each sets up .venv by itself.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

# The fits whose presets and cards are shipped. Rendering and fitting takes about an hour.
FITS := guertin2014 mcguire2012 sousa2013 jimenez2014 notes2025 tan2022 torchblur warp stream \
        pareto-guertin2014 pareto-notes2025

.PHONY: help demo test test-all test-times lint bench images presets clean

help:
	@echo "make demo   tune Guertin's filter on procedural scenes; report in runs/demo/report.html"
	@echo "make test   run the quick tests; make test-all: all of them"
	@echo "make lint   format, lint, types, import contracts"
	@echo "make bench  time filters and memory (leave the machine alone meanwhile)"
	@echo "make images the pictures of the README"
	@echo "make presets fit and write all presets that are shipped, and their cards (an hour)"

# torch comes first and by its exact version; its range in pyproject.toml is for other set-ups.
$(VENV)/.base: constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -r constraints.txt
	touch $@

$(VENV)/.tune: $(VENV)/.base pyproject.toml
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[tune]'
	touch $@

$(VENV)/.dev: $(VENV)/.base pyproject.toml
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@ $(VENV)/.tune

demo: $(VENV)/.tune
	$(BIN)/torchblur tune configs/tune/demo.yaml -o runs/demo --overwrite
	@echo "Open runs/demo/report.html"

# One torch thread per worker: two that share a core wait for each other.
test: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(BIN)/pytest -n auto -m "not slow and not twin"

test-all: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(BIN)/pytest -n auto

# Measures all tests (leave the machine alone meanwhile) and writes down which take long.
test-times: $(VENV)/.dev
	OMP_NUM_THREADS=1 TORCHBLUR_WRITE_TIMES=tests/slow.txt $(BIN)/pytest -n auto

lint: $(VENV)/.dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(VENV)/.tune
	$(BIN)/torchblur bench

images: $(VENV)/.tune
	$(BIN)/python -m tools.readme_images

presets: $(FITS:%=runs/%/result.json)
	$(BIN)/torchblur card $(FITS:%=runs/%) -o docs/presets --presets configs/filters --overwrite

# A run that was stopped goes on; after a change of its configuration remove its folder.
runs/%/result.json: configs/tune/%.yaml | $(VENV)/.tune
	$(BIN)/torchblur tune $< -o runs/$* --resume

clean:
	rm -rf $(VENV) runs out
