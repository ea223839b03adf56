# `make demo` and `make test` are all a newcomer needs. Each makes its own virtual environment first.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
PYTHONS ?= 3.10 3.11 3.12 3.13
DEMO ?= demo
DEMO_STEPS ?= 300
RESULTS ?= results
DEMO_FLAGS := --data $(DEMO)/phantom --steps $(DEMO_STEPS) --overwrite
# A run of two steps on a tiny scene compiles the kernels while the scene of the demonstration is made.
TINY := --frames 9 --size 64x52 --rotation-views 0 --set mesh_spacing=3 --set texture_spacing=1 --set interreflection=0
# Containers often forbid bytecode files; each process then compiles the whole package again, for three seconds.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo test test-thorough test-slow lint docs results notebooks matrix install install-dev system clean

demo: install
	@echo "1/5  a synthetic colon with exact depth, poses and light ..."
	@{ $(BIN)/coliags phantom --output $(DEMO)/tiny --overwrite $(TINY) && \
	   $(BIN)/coliags train coliags-plus --data $(DEMO)/tiny --steps 2 --output $(DEMO)/tiny-run --overwrite; \
	   rm -rf $(DEMO)/tiny $(DEMO)/tiny-run; } >/dev/null 2>&1 & \
	 $(BIN)/coliags phantom --output $(DEMO)/phantom --seed 0 --frames 60 --rotation-views 6 --size 254x203 --overwrite; \
	 status=$$?; wait; exit $$status
	@echo "2/5  coliags-plus, $(DEMO_STEPS) steps: half a minute on two cores ..."
	@$(BIN)/coliags train coliags-plus --output $(DEMO)/coliags-plus $(DEMO_FLAGS)
	@echo "3/5  Scaffold-GS with the same depth supervision, as many steps: half a minute ..."
	@$(BIN)/coliags train scaffold-gs-depth --output $(DEMO)/scaffold-gs-depth $(DEMO_FLAGS)
	@echo "4/5  held-out views of both: seconds ..."
	@$(BIN)/coliags eval $(DEMO)/coliags-plus
	@$(BIN)/coliags eval $(DEMO)/scaffold-gs-depth
	@echo "5/5  the report ..."
	@$(BIN)/coliags report $(DEMO)/coliags-plus $(DEMO)/scaffold-gs-depth --output $(DEMO)/report.html --overwrite \
	  --title "coliags-plus and Scaffold-GS on a synthetic colon" \
	  --note "A demonstration: $(DEMO_STEPS) steps on a CPU, where the paper trains 30,000."

# In a process per CPU, up to four; each would take all CPUs otherwise.
test: install-dev
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n auto --maxprocesses 4 --dist worksteal

# Long sweeps: fuzz, kills, full disks, browsers, notebooks, benchmarks and the contract of every ablation.
test-thorough: install-dev
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n auto --maxprocesses 4 --dist worksteal -m "thorough and not slow and not gpu"

test-slow: install-dev
	$(BIN)/python -m pytest -q -m slow

lint: install-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# The site, from docs/, README, CONTRIBUTING and docstrings, in build/site.
docs: install-dev $(VENV)/installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict --config-file docs/tools/mkdocs.yml
	@echo "built build/site/index.html"

# What docs/results.md has of phantoms-test, from nothing: runs, archive, tables and picture. Some two core hours.
results: install-dev
	$(BIN)/coliags compare rivals-in-time --scenes phantoms-test --threads 1 --output $(RESULTS)/phantoms \
	  --reference coliags-plus --primary psnr depth_mse_inner
	$(BIN)/python docs/tools/results.py pack $(RESULTS)/phantoms
	$(BIN)/python docs/tools/results.py tables
	$(BIN)/python docs/tools/results.py picture $(RESULTS)/phantoms

# The outputs stored in docs/notebooks.
notebooks: install-dev
	$(BIN)/python docs/tools/notebooks.py

# The test suite on every Python that is here.
matrix:
	@for version in $(PYTHONS); do \
	  if command -v python$$version >/dev/null && python$$version -V >/dev/null 2>&1; then \
	    $(MAKE) test PYTHON=python$$version VENV=build/venv-$$version || exit 1; \
	  else \
	    echo "python$$version is not here: not tested"; \
	  fi; \
	done

install: system $(VENV)/installed

install-dev: system $(VENV)/installed-dev

$(VENV):
	@$(PYTHON) -c 'import sys; sys.exit("Python 3.10 or newer is needed, not " + sys.version.split()[0] + "; try make PYTHON=python3.11" if sys.version_info < (3, 10) else 0)'
	$(PYTHON) -m venv $(VENV)

$(VENV)/installed: pyproject.toml constraints.txt | $(VENV)
	@echo "installing the package and PyTorch into $(VENV): about a minute and a half ..."
	@$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable .
	@touch $@

$(VENV)/installed-dev: pyproject.toml constraints.txt | $(VENV)
	@echo "installing the package, PyTorch and the tools of development into $(VENV): about two minutes ..."
	@$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable '.[dev]'
	@touch $@ $(VENV)/installed

$(VENV)/installed-docs: $(VENV)/installed-dev
	@$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable '.[docs]'
	@touch $@

# open3d loads the system's libusb; no Python package brings it.
system:
	@if [ "$$(uname)" = Linux ] && ! $(PYTHON) -c 'import ctypes; ctypes.CDLL("libusb-1.0.so.0")' 2>/dev/null; then \
	  if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	    echo "installing libusb-1.0-0, which open3d needs"; \
	    apt-get update -qq && apt-get install -y -qq --no-install-recommends libusb-1.0-0 >/dev/null; \
	  else \
	    echo "open3d needs libusb-1.0, and it is not here. Install it first:  sudo apt-get install libusb-1.0-0" >&2; \
	    exit 1; \
	  fi; \
	fi

clean:
	rm -rf $(VENV) $(DEMO) build dist
