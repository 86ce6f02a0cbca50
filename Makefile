# Everything below works on a fresh clone with Python 3.10+ (pip, venv) and a C++20 compiler; cmake and ninja come from
# PyPI. Each target does its own set-up, once: stamps under .venv and build remember what is done.
#
#   PYTHON=python3.12 make setup    another interpreter
#   make test PYTEST_ARGS="-k cli"  part of the tests
#   make setup LOCKED=1             the versions of requirements.lock, checked by hash

PYTHON ?= python3
PYTEST_ARGS ?=

VENV := .venv
PY := $(VENV)/bin/python
PIP := $(PY) -m pip --disable-pip-version-check install --quiet
TOOLS := $(VENV)/.stamp-tools
INSTALLED := $(VENV)/.stamp-installed
DOCS := $(VENV)/.stamp-docs
LINTERS := $(VENV)/.stamp-linters
SANITIZED := build/sanitize/.stamp
# Folders are listed too: their time changes when a file is added or removed.
NATIVE := CMakeLists.txt $(shell find csrc)

.PHONY: help setup demo test lint docs format stubs bench equal-bits fuzz fuzz-short sanitize races soak lock audit \
	ptx prove check-neon wheel check-wheel check-sdist check-dockerfile wheels clean

help:
	@echo "make setup        create .venv and build the package into it"
	@echo "make demo         reconstruct a built-in object into runs/demo"
	@echo "make test         run the tests"
	@echo "make lint         ruff, pyright, import-linter; actionlint, zizmor, hadolint, the conda recipe"
	@echo "make docs         the documentation as a site, build/docs/index.html; warnings are errors"
	@echo "make stubs        describe the native calls to Python (src/etsplat/_native.pyi)"
	@echo "make bench        measure the CPU engine"
	@echo "make equal-bits BASE=COMMIT  small runs end with the same bits as at that commit; CASES='scene-*' for some"
	@echo "make sanitize     run the tests of the C++ under ASan, LSan and UBSan (GCC, Linux)"
	@echo "make fuzz         a million changed files and 100,000 odd calls; FUZZ='--targets mesh*' for some; fuzz-short for a minute"
	@echo "make races        threads, forks and GPU kernels under ThreadSanitizer (GCC, Linux); RACES=300 for so many seconds"
	@echo "make ptx          tests of the GPU engine on the CPU, on what NVRTC compiles; PTX=compute_75 for one architecture"
	@echo "make prove        prove that plain GPU kernels have no races, by their PTX (needs a network, once)"
	@echo "make soak         kill runs, fill their disk, move their clock; SOAK=100 for so many of each (Linux)"
	@echo "make lock         requirements.lock: the newest versions that fit, with hashes; make audit: known holes in them"
	@echo "make check-neon   run the rasterizer's NEON path under QEMU (AArch64 cross compiler)"
	@echo "make check-wheel  build the wheel, install it into an empty environment, run a tiny demo; WHEEL=FILE for another, TORCH=2.6.0"
	@echo "make check-sdist  the same from the source distribution"
	@echo "make check-dockerfile  run the Dockerfile in chroots, as root, where debootstrap is; IMAGE='EXTRAS=cuda,sfm' for other arguments"
	@echo "make wheels       wheels of every platform by Zig's compilers, under dist/wheels (Python 3.12 or newer); WHEELS='macos-arm64' for one"
	@echo "make clean        remove .venv, build, dist and caches"

# The pinned torch goes first and alone, so that no later call has a reason to bring another build of it.
$(TOOLS): constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || \
		{ echo "etsplat needs Python 3.10 or newer; choose one with: make PYTHON=python3.12" >&2; exit 1; }
	test -x $(PY) || $(PYTHON) -m venv $(VENV)
	$(PIP) -c constraints.txt torch
	$(PIP) -c constraints.txt scikit-build-core nanobind cmake ninja
	$(PIP) -c constraints.txt numpy setuptools setuptools_scm wheel  # of meshoptimizer: no wheel, built beside ours
	@touch $@

# No build isolation: the build folder then survives, and a changed C++ file is rebuilt in seconds.
$(INSTALLED): $(TOOLS) pyproject.toml $(if $(LOCKED),requirements.lock) $(NATIVE)
	$(PIP) 'pip>=25.1'  # which knows --group
ifdef LOCKED
	$(PIP) --no-deps --require-hashes -r requirements.lock
	$(PIP) --no-deps --no-build-isolation -e .
else
	$(PIP) -c constraints.txt --no-build-isolation -e . --group dev
endif
	@touch $@

setup: $(INSTALLED)

demo: setup
	$(VENV)/bin/etsplat demo --out runs/demo --overwrite

test: setup
	$(PY) -m pytest -n auto $(PYTEST_ARGS)

# Of workflows, containers and the conda recipe; they come from the group `lint`; where LOCKED, `setup` has brought them.
$(LINTERS): $(INSTALLED)
	$(PIP) --group lint
	@touch $@

lint: $(LINTERS)
	$(VENV)/bin/actionlint -shellcheck= -pyflakes=  # which it would run where it finds them
	$(VENV)/bin/zizmor --offline --quiet .github/workflows
	$(VENV)/bin/hadolint Dockerfile .devcontainer/Dockerfile
	$(PY) release/recipe.py
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/pyright
	$(VENV)/bin/lint-imports --no-cache

# Sphinx and its like come from the group `docs`, likewise.
$(DOCS): $(INSTALLED)
	$(PIP) -c constraints.txt --group docs
	@touch $@

docs: $(DOCS)
	$(PY) -m sphinx --builder html --fresh-env --write-all --fail-on-warning --keep-going --quiet \
		--conf-dir docs --doctree-dir build/doctrees . build/docs

format: setup
	$(VENV)/bin/ruff check --fix .
	$(VENV)/bin/ruff format .

stubs: setup
	$(PY) -m tests.helpers.stubs src/etsplat/_native.pyi

bench: setup
	$(PY) -m benchmarks.rasterizer
	$(PY) -m benchmarks.ops

# BASE is built once, under build/equal_bits, and its results are kept; FRESH=1 makes them anew.
CASES ?= *
equal-bits: setup
	@test -n "$(BASE)" || { echo "Which commit to compare with? make equal-bits BASE=main" >&2; exit 1; }
	$(PY) -m tests.equal_bits --base "$(BASE)" --cases "$(CASES)" $(if $(FRESH),--fresh)

# A second build, beside the first, with assertions and line numbers. `python -S` leaves out the editable install, so that
# `etsplat` is the sanitized one. libstdc++ is preloaded too: ASan looks for the exception functions when it starts.
SITE = $(shell $(PY) -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
$(SANITIZED): $(INSTALLED) $(shell find src -name '*.py')
	$(PIP) --no-build-isolation --no-deps --upgrade --target build/sanitize/site \
		--config-settings=build-dir=build/sanitize/cmake --config-settings=cmake.define.ETSPLAT_SANITIZE=ON \
		--config-settings=cmake.build-type=Debug --config-settings=install.strip=false .
	ln -f build/sanitize/site/etsplat/_native.abi3.so build/sanitize/cmake/
	@touch $@

# Leaks are told by the innermost frames of an allocation, for which tests/native/leaks.supp says whose are left out; one that
# is planted must be told.
SANITIZER := LD_PRELOAD="$$($(CXX) -print-file-name=libasan.so) $$($(CXX) -print-file-name=libstdc++.so)" \
	ASAN_OPTIONS=detect_leaks=1:malloc_context_size=4 UBSAN_OPTIONS=print_stacktrace=1 \
	LSAN_OPTIONS=suppressions=$(CURDIR)/tests/native/leaks.supp:print_suppressions=0
sanitize: $(SANITIZED)
	echo 'extern "C" void plant() { new int[100]; }' | $(CXX) -x c++ -shared -fPIC -o build/sanitize/planted.so -
	! $(SANITIZER) $(PY) -S -c 'import ctypes; ctypes.CDLL("build/sanitize/planted.so").plant()' 2> build/sanitize/planted.log
	grep -q 'in plant' build/sanitize/planted.log
	$(SANITIZER) PYTHONPATH="$(CURDIR)/build/sanitize/site:$(SITE)" \
		$(PY) -S -m pytest -p no:cacheprovider -m sanitize $(PYTEST_ARGS)

# Odd input: a seed makes the same inputs everywhere, and the short form's are counted, so that a faster machine tries
# nothing that FUZZ_SHORT without its seconds has not tried. What fails is kept under build/fuzz.
FUZZ ?=
FUZZ_SHORT := --inputs 41600 --calls 36000
fuzz: setup
	PYTHONPATH=tests $(PY) -m tests.fuzz $(FUZZ)

fuzz-short: setup
	PYTHONPATH=tests $(PY) -m tests.fuzz $(FUZZ_SHORT) --seconds 60 $(FUZZ)

# Each task is disturbed so many times in each way; the folders that do not end equal stay under build/soak.
SOAK ?= 20
soak: setup
	PYTHONPATH=tests $(PY) -m tests.soak --trials $(SOAK)

# Every file of kernels, and whole steps: what .ci/run has time for, some 100 s of one processor with all that is compiled.
KERNEL_TESTS := tests/engines tests/ops/test_cuda_ops.py tests/ops/test_texture.py tests/ops/test_triangle_channels.py \
	tests/ops/test_normal_consistency.py tests/ops/test_soup_activation.py \
	tests/ops/test_rasterize_engines.py::test_softness_from_sharp_to_flat \
	tests/optim/test_terms.py::test_mean_area_agrees_with_the_float64_reference \
	tests/tasks/test_cuda_train.py::test_replayed_steps_are_those_that_are_called \
	tests/tasks/test_cuda_reconstruct.py::test_replayed_steps_are_those_that_are_called

# The threads of the C++, and those of the GPU engine's kernels: all tests that run kernels on the CPU, where only what orders
# memory on a device orders it (tests/helpers/simt/races.h). Each test fails for what is reported in it.
RACES ?= 60
RACES_TESTS ?= tests
RACER = TSAN_OPTIONS="log_path=$(CURDIR)/build/races/report exitcode=0 ignore_noninstrumented_modules=1 \
	report_signal_unsafe=0 report_thread_leaks=0 suppress_equal_addresses=0 history_size=2" \
	LD_PRELOAD="$$($(CXX) -print-file-name=libtsan.so)" setarch --addr-no-randomize
races: setup
	tests/native/run.sh races $(RACES)
	tests/native/run.sh forks $(RACES)
	rm -rf build/races
	mkdir -p build/races
	$(RACER) $(PY) -m pytest -p no:cacheprovider -n auto $(RACES_TESTS) $(PYTEST_ARGS)

# Kernels as NVRTC compiles them, translated to C++ (tests/helpers/simt/ptx.py), in all tests that run them on the CPU.
PTX ?= compute_75 compute_90
PTX_TESTS ?= tests
ptx: setup
	for architecture in $(PTX); do $(PY) -m pytest -n auto --ptx $$architecture $(PTX_TESTS) $(PYTEST_ARGS) || exit 1; done

# What no order of threads can make race, by the PTX alone (tests/proofs.py). sentryward comes from the group `proofs`.
prove: setup
	$(PIP) --group proofs
	PYTHONPATH=tests $(PY) -m tests.proofs

# The NEON path under an emulator, where there is no ARM machine (Debian: g++-aarch64-linux-gnu qemu-user).
check-neon:
	tests/native/run.sh neon

# The newest versions that fit, for every Python and system, with the hashes of the registry's files. torch is left out: which
# build of it is right (CPU, CUDA) depends on the machine, and with it the hash; constraints.txt has its version.
LOCK := $(PY) -m uv pip compile --universal --python-version 3.10 --generate-hashes --no-annotate --no-header \
	-c constraints.txt --extra cuda --extra compress --extra depth --extra heic --extra sfm --extra slurm --extra texture --extra tune \
	--extra video --extra viewer --extra webgpu --group pyproject.toml:dev --group pyproject.toml:docs \
	--group pyproject.toml:lint pyproject.toml
lock: setup
	$(PIP) uv
	printf "torch ; python_version < '3'\netsplat ; python_version < '3'\n" > build/without.txt
	$(LOCK) --override build/without.txt --quiet --output-file requirements.lock

# Known holes in what the lock names. It asks the registry's database of advisories: it needs a network, so no check of every change.
audit: setup
	$(PIP) pip-audit
	$(PY) -m pip_audit --disable-pip --require-hashes --requirement requirements.lock

# By the tools of `setup`, in its build folder: what the one has compiled the other need not.
wheel: $(TOOLS)
	rm -f dist/*.whl
	$(PY) -m pip --disable-pip-version-check wheel --quiet --no-deps --no-build-isolation --check-build-dependencies --wheel-dir dist .

# What a user gets: the wheel alone, in an environment with nothing else, away from the source tree. That environment is
# a gigabyte, byte code left out, so it goes when it has passed. WHEEL names one that is there already, say of `make wheels`.
WHEEL ?=
TORCH ?=
check-wheel check-sdist: export PYTHONDONTWRITEBYTECODE = 1
check-wheel check-sdist: INSTALL := -m pip --disable-pip-version-check install --quiet --no-compile
check-wheel check-sdist: INSTALL_TORCH := $(INSTALL) $(if $(TORCH),torch==$(TORCH),-c constraints.txt torch)
check-wheel: $(if $(WHEEL),,wheel)
	rm -rf build/wheel-check
	$(PYTHON) -m venv build/wheel-check/venv
	build/wheel-check/venv/bin/python $(INSTALL_TORCH)
	build/wheel-check/venv/bin/python $(INSTALL) $(or $(WHEEL),dist/*.whl)
	cd build/wheel-check && venv/bin/etsplat doctor
	cd build/wheel-check && venv/bin/etsplat demo --out demo --preset tiny
	test -s build/wheel-check/demo/report.html
	rm -rf build/wheel-check

# The same of the source distribution, which is compiled with what it asks for itself (build isolation), away from the checkout.
check-sdist: $(TOOLS)
	rm -rf build/sdist-check
	mkdir -p build/sdist-check
	$(PY) -c 'from scikit_build_core.build import build_sdist; build_sdist("build/sdist-check")'
	$(PYTHON) -m venv build/sdist-check/venv
	build/sdist-check/venv/bin/python $(INSTALL_TORCH)
	build/sdist-check/venv/bin/python $(INSTALL) build/sdist-check/*.tar.gz
	cd build/sdist-check && venv/bin/etsplat doctor
	cd build/sdist-check && venv/bin/etsplat demo --out demo --preset tiny
	test -s build/sdist-check/demo/report.html
	rm -rf build/sdist-check

# Every line of the Dockerfile where there is no Docker, and what the image is for (release/dockerfile.py).
IMAGE ?=
check-dockerfile:
	$(PYTHON) release/dockerfile.py build/image $(IMAGE)

# They hold nanobind, so they need no other compiler's exceptions to be theirs; in an environment of its own, without torch.
WHEELS ?=
CROSS := build/wheels/venv
wheels:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 12))' || \
		{ echo "make wheels needs Python 3.12 or newer; choose one with: make wheels PYTHON=python3.12" >&2; exit 1; }
	test -x $(CROSS)/bin/python || $(PYTHON) -m venv $(CROSS)
	$(CROSS)/bin/python -m pip --disable-pip-version-check install --quiet 'pip>=25.1'
	$(CROSS)/bin/python -m pip --disable-pip-version-check install --quiet --group wheels
	PATH="$(CURDIR)/$(CROSS)/bin:$$PATH" $(CROSS)/bin/python release/wheels.py $(WHEELS)

clean:
	rm -rf $(VENV) build dist docs/generated .pytest_cache .ruff_cache .hypothesis
	find src tests benchmarks docs studies examples -name __pycache__ -type d -prune -exec rm -rf {} +
