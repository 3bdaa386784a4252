# make demo      install, then turn examples/still_life into a baked asset, turntable, mesh and point cloud under runs/demo
# make test      install, then run the tests on all cores, but those marked slow
# make test-slow install, then run the tests marked slow
# make test-all  both in one go, as .ci/run does: the long ones first, and what one of them compiles is there for the others
# make torture   kill runs at N moments (30; by night 1000: make torture N=1000 JOBS=2) and compare their artifacts with those of undisturbed runs
# make faults    let a file operation of each kind and place of a run fail, by five errors: half an hour on two cores (make faults JOBS=2)
# make fuzz      100,000 damaged inputs to each reader; FUZZ_OPTIONS go to benchmarks/fuzz; `pip install -e '.[fuzz]'` guides it by coverage
# make gpu       the tests and benchmarks that need CUDA; says so and stops where there is none
# make gpu-packages   wheels that `make gpu` needs besides torch, Triton and numba, into build/gpu-packages: for a machine without a package index
# make processors   the kernels' tests as on x86-64 processors without AVX-512, and without AVX: numba compiles for those
# make viewer-page   write docs/still_life_viewer.html, which the README links: ten minutes on two cores
# make docs      rewrite the pages under docs/ that are made from the code
# make lint      ruff and mypy
# make site      build the documentation as a site into build/site; links that lead nowhere are errors
# make container build the image for a CPU, and run the sample in it; make container FOR=cuda: that for CUDA
# make release   build sdist and wheel, and try the wheel in empty environments; RELEASE_OPTIONS go to .ci/release.py (--quick only builds)
# make publish   upload what `make release` built

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
# In the order of tests/conftest.py: by itself xdist begins with the files that have most tests, and a worker ends alone with a long one.
PYTEST := $(BIN)/python -m pytest -q -n auto --dist loadfile --no-loadscope-reorder

.PHONY: demo test test-slow test-all torture faults processors gpu gpu-packages viewer-page docs lint site container release publish install clean

demo: $(INSTALLED)
	$(BIN)/enerf run examples/still_life --out runs/demo

test: $(INSTALLED)
	$(PYTEST) -m "not slow"

test-slow: $(INSTALLED)
	$(PYTEST) -m slow

test-all: $(INSTALLED)
	$(PYTEST) --durations 15

N ?= 30
JOBS ?= 1
torture: $(INSTALLED)
	$(BIN)/python -m benchmarks.torture --kills $(N) --jobs $(JOBS)

faults: $(INSTALLED)
	$(BIN)/python -m benchmarks.torture.faults --jobs $(JOBS)

fuzz: $(INSTALLED)
	$(BIN)/python -m benchmarks.fuzz $(FUZZ_OPTIONS)

# A machine with a device often has a python whose torch sees it, and no way to a package index: then that one is used, and nothing is installed.
# What it lacks is installed into build/gpu-site from the wheels in build/gpu-packages, which `make gpu-packages` downloads elsewhere, for python GPU_PYTHON.
# GPU_OPTIONS go to benchmarks/gpu.py, which ends within ten minutes.
GPU_PACKAGES := build/gpu-packages
GPU_PYTHON ?= 3.12
gpu:
	@if ls $(GPU_PACKAGES)/*.whl >/dev/null 2>&1; then \
		$(PYTHON) -m pip install --quiet --no-index --no-deps --upgrade --target build/gpu-site $(GPU_PACKAGES)/*.whl; \
	fi; \
	export PYTHONPATH="build/gpu-site$${PYTHONPATH:+:$$PYTHONPATH}"; \
	if $(PYTHON) -c "import sys, numba, torch, triton; sys.exit(not torch.cuda.is_available())" 2>/dev/null; then \
		$(PYTHON) -c "import msgspec, platformdirs" || { echo "fill $(GPU_PACKAGES) with 'make gpu-packages' where there is a package index, and bring it here"; exit 1; }; \
		$(PYTHON) benchmarks/gpu.py $(GPU_OPTIONS); \
	else \
		unset PYTHONPATH; $(MAKE) --no-print-directory install && $(BIN)/python benchmarks/gpu.py $(GPU_OPTIONS); \
	fi

gpu-packages:
	rm -rf $(GPU_PACKAGES)
	$(PYTHON) -m pip download --quiet --dest $(GPU_PACKAGES) --no-deps --only-binary=:all: --python-version $(GPU_PYTHON) --implementation cp \
		--platform manylinux_2_28_x86_64 --platform manylinux_2_17_x86_64 -c constraints.txt filelock msgspec platformdirs trimesh OpenEXR av fast_simplification backports.zstd

PROCESSORS := haswell:+avx,+avx2,+fma,+f16c,+bmi,+bmi2,+lzcnt,+popcnt,+movbe,+sse4.2,+cx16 x86-64:+sse2
KERNEL_TESTS ?= tests/efficientnerf/backends tests/efficientnerf/asset/test_format.py
processors: $(INSTALLED)
	for each in $(PROCESSORS); do \
		NUMBA_CPU_NAME=$${each%%:*} NUMBA_CPU_FEATURES=$${each#*:} ENERF_CACHE_DIR=$(CURDIR)/build/processors $(BIN)/python -m pytest -q $(KERNEL_TESTS) || exit 1; \
	done

viewer-page: $(INSTALLED)
	$(BIN)/enerf run examples/still_life --out runs/page --set bake.resolution=112 --until bake
	$(BIN)/python docs/make_viewer_page.py runs/page

docs: $(INSTALLED)
	$(BIN)/python docs/make_pages.py

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/mypy

# The tree of the documents and of all that they link, as it is in the repository.
SITE_FILES := README.md CHANGELOG.md SECURITY.md docs examples benchmarks/results tests/stages/hostile.py tests/efficientnerf/hostile.py efficientnerf/asset/FORMAT.md
site:
	rm -rf build/site-source && mkdir -p build/site-source
	tar -cf - --exclude '*.jpg' --exclude __pycache__ $(SITE_FILES) | tar -xf - -C build/site-source
	$(PYTHON) -m venv build/site-tools
	build/site-tools/bin/python -m pip install --quiet "mkdocs-material>=9.5,<10"
	build/site-tools/bin/python -m mkdocs build

# CONTAINER builds and runs images: podman, docker, or one that takes their options. CONTAINER_OPTIONS go to the build, such as --build-arg BASE=...
CONTAINER ?= podman
FOR ?= cpu
container:
	$(CONTAINER) build --file Containerfile --build-arg FOR=$(FOR) $(CONTAINER_OPTIONS) --tag enerf:$(FOR) .
	$(CONTAINER) run --rm $(RUN_OPTIONS) enerf:$(FOR) --version
	$(CONTAINER) run --rm $(RUN_OPTIONS) -v $(CURDIR)/examples/still_life:/photos:ro enerf:$(FOR) run /photos --preset tiny --out /runs/sample

release:
	$(PYTHON) -m venv build/release/tools
	build/release/tools/bin/python -m pip install --quiet build twine uv pipx
	build/release/tools/bin/python .ci/release.py $(RELEASE_OPTIONS)

publish:
	build/release/tools/bin/python .ci/release.py --publish

install: $(INSTALLED)

# torch first and on its own: its version decides the rest.
$(INSTALLED): pyproject.toml constraints.txt
	@$(PYTHON) -c "import sys; sys.exit('$(PYTHON) is %d.%d; Python 3.11 or newer is needed. Try: make PYTHON=python3.11 ...' % sys.version_info[:2] if sys.version_info < (3, 11) else 0)"
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet $(PIP_OPTIONS) torch==2.13.0
	$(BIN)/python -m pip install --quiet $(PIP_OPTIONS) -c constraints.txt -e '.[dev]'
	@touch $@
	@$(BIN)/python -m workflows.precompilation  # some minutes, in the background

# Runs are kept: they are the user's.
clean:
	rm -rf $(VENV) build .mypy_cache .ruff_cache .pytest_cache
