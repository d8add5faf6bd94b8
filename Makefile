# The few commands a developer needs. Each sets up what it needs in .venv, from Python 3.11+ and make alone.

PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
PIP    := $(BIN)/python -m pip --disable-pip-version-check install --quiet -c constraints.txt
HOST   ?= 127.0.0.1
PORT   ?= 8080
# Processes of tests. One more than CI's two cores: tests wait for browsers, servers, and other processes.
JOBS   ?= 3

.PHONY: explore setup test test-all check check-types check-style coverage mutations bench keep keep-slow wheel docs fuzz soak demo format audit clean
.DEFAULT_GOAL := test

$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed; this is " + sys.version) if sys.version_info < (3, 11) else None'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.base: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) -e '.[maps]'
	touch $@

# timm without its requirement torchvision, whose compiled operators need one build of torch; see lpn/models/timm_networks.py.
TIMM := $(PIP) --no-deps timm

$(VENV)/.train: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) torch==2.13.0
	$(PIP) -e '.[train,maps]'
	$(TIMM)
	touch $@ $(VENV)/.base

$(VENV)/.dev: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) torch==2.13.0
	$(PIP) -e '.[train,dev]'
	$(TIMM)
	touch $@ $(VENV)/.train $(VENV)/.base

# Blender as a Python module, which renders the demo's city: about 1 GB, Python 3.11 only.
$(VENV)/.world: $(VENV)/.train
	$(PIP) -e '.[train]' 'bpy>=5.0,<5.1'
	touch $@

# TypeScript's checker and eslint, which read the page's scripts. Node.js and npm come with the development tools.
JS := tools/javascript
$(VENV)/.javascript: $(JS)/package.json $(JS)/package-lock.json $(VENV)/.dev
	PATH="$(abspath $(BIN)):$$PATH" npm ci --prefix $(JS) --silent
	touch $@

# The Milvus server that the tests of that index run against, in an environment of its own: it needs packages of its time.
$(VENV)/.milvus: | $(BIN)/python
	$(PYTHON) -m venv $(VENV)/milvus
	$(VENV)/milvus/bin/python -m pip --disable-pip-version-check install --quiet milvus==2.3.5 'setuptools<81' 'marshmallow<4'
	touch $@

# A browser for the tests: the system's, else Debian's package (as root), else playwright's own.
$(VENV)/.browser: $(VENV)/.dev
	@command -v chromium >/dev/null \
	  || { [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && apt-get update -qq && apt-get install -y -qq chromium; } \
	  || $(BIN)/playwright install chromium \
	  || { echo "The browser tests need Chromium; install it (Debian: apt-get install chromium)." >&2; exit 1; }
	touch $@

# An exported model needs no torch, nor do those that ship; any other does.
SHIPPED := $(basename $(notdir $(wildcard assets/models/*.json)))
EXPLORE_NEEDS := $(if $(filter-out %.onnx $(SHIPPED),$(MODEL) $(BESIDE)),$(VENV)/.train,$(VENV)/.base)

explore: $(EXPLORE_NEEDS)
	@$(BIN)/lpn explore $(if $(DATA),"$(DATA)") $(if $(MODEL),--model "$(MODEL)") $(if $(BESIDE),--beside "$(BESIDE)") --host $(HOST) --port $(PORT)

setup: $(VENV)/.train
	@echo "Ready. Use it with: . $(VENV)/bin/activate"

# One thread a process: the tests' networks are so small that threads cost more than they save, on a busy machine many times.
# Bytecode is kept: hundreds of processes that the tests start would each compile the same files again.
PYTEST := OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n $(JOBS)

# Every module and the browser, in minutes. A process that has nothing left to do takes over half of what another still has.
test: check $(VENV)/.browser
	$(PYTEST) --dist worksteal --durations 40

# Everything: all tests, what must not get worse, a short fuzz run, and a short soak. A whole file goes to one process, which shares
# its servers; the files come in the order of tests/conftest.py, and not by their numbers of tests.
# Fuzzing takes one core, and a soak waits for most of its time; its caches are full after a minute.
test-all coverage: export LPN_MILVUS_PYTHON := $(abspath $(VENV)/milvus/bin/python)
test-all: check $(VENV)/.browser $(VENV)/.milvus
	$(PYTEST) --dist loadfile --no-loadscope-reorder -m '' --durations 40 --durations-min 5
	$(MAKE) keep
	$(MAKE) -j2 fuzz soak INPUTS=300 MINUTES=3 ALONE=15 CLIENTS=8 PAGES=1

# Lines and branches that the tests run: make coverage TESTS="-m ''" with the slow tests. pyproject.toml has the settings.
coverage: export COVERAGE_FILE := $(abspath runs/coverage/data)
coverage: $(VENV)/.browser $(VENV)/.milvus
	rm -rf runs/coverage && mkdir -p runs/coverage
	$(subst -m pytest,-m coverage run -m pytest,$(PYTEST)) --dist worksteal $(TESTS); status=$$?; \
	$(BIN)/python -m coverage combine --quiet && $(BIN)/python -m coverage report --skip-covered --sort=cover && exit $$status

# Each planted fault must be noticed: make mutations NAMES="swapped-views" for some of tools/mutations.txt.
mutations: $(VENV)/.dev
	$(BIN)/python -m tools.mutations $(NAMES)

# mypy takes as long as all other checks together.
check: $(VENV)/.javascript
	$(MAKE) -j2 check-types check-style

check-types: $(VENV)/.dev
	$(BIN)/mypy

check-style: $(VENV)/.javascript
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	PATH="$(abspath $(BIN)):$$PATH" $(JS)/node_modules/.bin/tsc -p $(JS)
	PATH="$(abspath $(BIN)):$$PATH" $(JS)/node_modules/.bin/eslint -c $(JS)/eslint.config.js explorer

format: $(VENV)/.dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# What people install: the sdist, the wheel of it, and the demo of an environment that has the wheel and the base packages alone.
wheel: $(VENV)/.browser
	$(PYTEST) -n 0 -m '' tests/e2e/test_installed.py

# The documentation as a site in site/, with the options of every command; a link that leads nowhere fails it.
docs: $(VENV)/.dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet

bench: $(VENV)/.browser
	$(BIN)/python -m tools.bench $(BENCH)

# What must not get worse, beside its baseline: make keep OUT=keep.json. The slow half wants the real data, and goes on after a stop.
keep: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(BIN)/python -m tools.keep $(if $(OUT),--out "$(OUT)")

keep-slow: $(VENV)/.dev
	$(BIN)/python -m tools.keep --slow $(if $(OUT),--out "$(OUT)")

# Every reader, on small real files damaged with a fixed seed: make fuzz INPUTS=10000
fuzz: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(BIN)/python -m tools.fuzz.readers --inputs $(or $(INPUTS),10000)

# Many people at once, every answer checked: make soak MINUTES=10 CLIENTS=20 PAGES=2 SEED=0 ALONE=60 OUT=soak.json
soak: $(VENV)/.browser
	$(BIN)/python -m tools.soak $(if $(MINUTES),--minutes $(MINUTES)) $(if $(CLIENTS),--clients $(CLIENTS)) $(if $(PAGES),--pages $(PAGES)) \
	  $(if $(SEED),--seed $(SEED)) $(if $(ALONE),--alone $(ALONE)) $(if $(DATA),"$(DATA)") $(if $(MODEL),--model "$(MODEL)") $(if $(OUT),--out "$(OUT)")

# The demo made again, in runs/: a city rendered, LPN and its baseline trained alike on it, all packed. Every step goes on where
# it stopped. INIT=file: ImageNet weights of a ResNet-18, with torchvision's names; without it networks start from random weights.
DEMO_TRAIN = $(BIN)/lpn train --data runs/world --recipe world $(if $(INIT),--init "$(INIT)",--from-scratch)
demo: $(VENV)/.world
	$(BIN)/python -m tools.world --out runs/world --seed 0 --buildings 460 --views 8 --tile-pixels 384 --samples 4
	$(DEMO_TRAIN) --out runs/demo/lpn $(if $(wildcard runs/demo/lpn/state.pt),--resume)
	$(DEMO_TRAIN) --out runs/demo/baseline --n-parts 1 $(if $(wildcard runs/demo/baseline/state.pt),--resume)
	test -d runs/demo/packed \
	  || $(BIN)/python -m assets.pack runs/world runs/demo/lpn/last.safetensors runs/demo/baseline/last.safetensors runs/demo/packed

# Known weaknesses of the packages that people install, and their licenses. It needs the network, so no test calls it.
$(VENV)/.audit: | $(BIN)/python
	$(PYTHON) -m venv $(VENV)/audit
	$(VENV)/audit/bin/python -m pip --disable-pip-version-check install --quiet pip-audit pip-licenses
	touch $@

audit: $(VENV)/.train $(VENV)/.audit
	$(VENV)/audit/bin/pip-licenses --python=$(BIN)/python --order=license
	$(VENV)/audit/bin/pip-audit --vulnerability-service=osv --progress-spinner=off --skip-editable --path "$$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')"

clean:
	rm -rf $(VENV) $(JS)/node_modules .mypy_cache .pytest_cache .ruff_cache *.egg-info
