# From a fresh clone, with python3 (3.10 or newer) and make alone: `make demo`, `make test`.
PYTHON ?= python3
VENV ?= .venv
ARCH ?= cpu
# Plain `torch` on Linux brings gigabytes of CUDA; the CPU index has the same version without. Set TORCH_INDEX= to have the former.
# Torch is installed first and alone, so that nothing else is looked for there.
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
EXTRA_INDEX = $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX))
BIN = $(VENV)/bin
INSTALLED = $(VENV)/installed
RUN = runs/demo

.PHONY: demo test test-all lint wheel-test docs gallery bench clean install

install: $(INSTALLED)

$(INSTALLED): pyproject.toml setup.py constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --retries 1 --upgrade pip
	$(BIN)/python -m pip install --quiet --retries 1 $(EXTRA_INDEX) -c constraints.txt --no-deps torch
	$(BIN)/python -m pip install --quiet --retries 1 -c constraints.txt -e '.[dev]'
	touch $@

demo: $(INSTALLED)
	$(BIN)/masiv identify assets/sample --out $(RUN) --preset quick --arch $(ARCH)
	$(BIN)/masiv evaluate $(RUN) --truth assets/sample/gt --arch $(ARCH)
	@echo "open $(RUN)/report.html"

# Two processes of one thread each (tests/conftest.py); a file's tests share what its fixtures make.
PYTEST = $(BIN)/python -m pytest --numprocesses 2 --dist loadfile

test: lint
	$(PYTEST) -m "not slow"

# Exit code 5 of pytest: no test is marked.
test-all: wheel-test docs
	$(PYTEST) -m slow || test $$? -eq 5

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/lint-imports --no-cache

wheel-test: $(INSTALLED)
	$(BIN)/python tests/wheel/check.py $(if $(TORCH_INDEX),--torch-index $(TORCH_INDEX))

# A page that is missing, a link or an anchor that leads nowhere, a formula that cannot be drawn are errors.
docs: $(INSTALLED)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict
	@echo "open build/site/index.html, or with search: $(PYTHON) -m http.server -d build/site"

# The clips of the effects, which are kept in docs/gallery.
gallery: $(INSTALLED)
	$(BIN)/python docs/gallery.py

# Those that need no scene, run or measurement; refine_tracks, which needs none either, is one case after the other.
BENCHMARKS = dam_break dissipation hidden_in_law mpm_speed transfer

bench: $(INSTALLED)
	@for name in $(BENCHMARKS); do echo "== $$name"; $(BIN)/python benchmarks/$$name.py || exit 1; done
	@echo "== the others need arguments, or hours:"
	@grep -h "^    python benchmarks/" $(filter-out $(BENCHMARKS:%=benchmarks/%.py),$(wildcard benchmarks/*.py))

clean:
	rm -rf $(VENV) build runs *.egg-info .pytest_cache .ruff_cache .hypothesis
