# The two commands: `make demo` and `make test`. Nothing else is needed on a machine with Python 3.11+ and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
PIP := $(BIN)/python -m pip --disable-pip-version-check
export UV_LINK_MODE := copy
# As pip does: the certificate authorities of the machine, such as that of a company's proxy.
export UV_SYSTEM_CERTS := true
# Where this is set, every process of ours compiles all that it imports anew: 12 s each for Prefect.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo test test-newest test-oldest page docs lint types check format env lock bench audit detector soak clean

demo: page  ## simulate a flight, run the whole job, say where the report is
	$(BIN)/velfield demo --out demo

# Where a process of the tests dies, they end with the name of its test: xdist waits for ever where it starts another.
IN_TWO := -n 2 --dist loadfile --no-loadscope-reorder --max-worker-restart=0
# Two processes on two cores: BLAS threads of their own make training in the tests many times slower.
test: export OPENBLAS_NUM_THREADS := 1
test: export OMP_NUM_THREADS := 1
# While one processor checks the types the other compiles the kernels, which both processes of the tests would do.
test: page  ## every check: lint, types, tests
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python page/build.py --check-types
	$(BIN)/python -m velfield.pipeline.compile_kernels & kernels=$$!; $(BIN)/mypy && wait $$kernels || { kill $$kernels; exit 1; }
	$(BIN)/python -m pytest $(IN_TWO)

# In build/newest and build/oldest, without the lock: what somebody gets who installs the wheel today, or beside old
# software. The tools of the tests are the newest there too; numba would go up with the numpy that they bring.
RESOLUTION_newest := highest
RESOLUTION_oldest := lowest-direct
test-newest test-oldest: export OPENBLAS_NUM_THREADS := 1
test-newest test-oldest: export OMP_NUM_THREADS := 1
test-newest test-oldest: test-%: page  ## the tests on the newest, the oldest versions that pyproject.toml allows
	$(PYTHON) -m venv --clear build/$*
	$(BIN)/uv pip install --quiet --python build/$*/bin/python --resolution $(RESOLUTION_$*) --editable ".[gis,s3]"
	$(BIN)/uv pip list --quiet --python build/$*/bin/python | awk '/^numba /{print $$1 "==" $$2}' > build/$*.txt
	$(BIN)/uv pip install --quiet --python build/$*/bin/python --constraint build/$*.txt --editable ".[dev,gis,s3]"
	$(BIN)/uv pip list --quiet --python build/$*/bin/python
	build/$*/bin/python -m pytest $(IN_TWO)

# The viewer's page from page/: built where its sources changed. Node is the machine's, else PyPI's into the environment.
page: $(STAMP)
	@$(BIN)/python page/build.py --has-node || $(PIP) install --quiet "$$($(BIN)/python page/build.py --node-wheel)"
	@$(BIN)/python page/build.py

env: page  ## the environment, with the viewer's page

# uv installs the locked environment in seconds where pip takes two minutes; pip brings uv, and does its work where uv
# cannot: where only a certificate authority that uv does not read is trusted, say.
$(STAMP): requirements.lock pyproject.toml
	@echo "make: the environment first; half a minute, or two on a slow machine"
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@{ $(PIP) install --quiet "uv>=0.8" && $(BIN)/uv pip install --quiet --python $(BIN)/python --require-hashes -r requirements.lock; } \
	  || { echo "make: uv could not install the packages; pip installs them, in about two minutes"; \
	       $(PIP) install --quiet --no-deps --require-hashes -r requirements.lock; }
	@$(PIP) install --quiet --no-deps --no-build-isolation --editable .
	@touch $@

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: page
	$(BIN)/mypy
	$(BIN)/python page/build.py --check-types

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# stabilo, the peer of registration, declares torch and kornia for detectors that are not used here (gigabytes), and
# OpenCV below 5; with --no-deps it runs on what is there. So it stands here and not in the lock, as do
# trackpy, the peer of linking, and boost-histogram and xhistogram, those of accumulation.
bench: $(STAMP)  ## speed, as ratios against a peer in the same run
	$(BIN)/uv pip install --quiet --python $(BIN)/python --no-deps stabilo==1.4.7
	$(BIN)/uv pip install --quiet --python $(BIN)/python trackpy boost-histogram xhistogram
	$(BIN)/velfield bench speed

# Of the lock, in an environment of the tool's own. Strict: a package that the service does not know fails the audit.
audit: $(STAMP)  ## known vulnerabilities of the pinned packages, by pip-audit, which asks PyPI or OSV
	$(BIN)/uv tool run --quiet pip-audit --requirement requirements.lock --require-hashes --disable-pip --strict --progress-spinner off

soak: $(STAMP)  ## fifty kills at random moments: every result equal to the bit
	$(BIN)/python -m tests.kills --kills 50

docs: $(STAMP)  ## the documentation as pages, in build/docs
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet

detector: $(STAMP)  ## train the detector that ships further: make detector DATA=folder with the sets of tools/training_data.py
	$(BIN)/python -m tools.make_detector $(DATA)

# Universal, with hashes, and without a registry's address in it.
lock: $(STAMP)
	$(BIN)/uv pip compile pyproject.toml --extra dev --extra gis --extra s3 --universal --no-emit-index-url --no-emit-find-links \
	  --generate-hashes --no-annotate --no-header --python-version 3.11 -o requirements.lock

clean:
	rm -rf $(VENV) demo dist build velfield/report/page page/node_modules
