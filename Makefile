# lads: the two commands a fresh machine needs are `make run` and `make test`.
# Needs Rust 1.95+, Python 3.11+, make and a C compiler; everything else is fetched from package registries.

PYTHON ?= python3
VENV   := .venv
PY     := $(VENV)/bin/python
MODEL  ?= models/kitchen.onnx
ARGS   ?=
JOB    ?=
INPUTS ?= models/lorel.onnx models/lorel-image.results.json
ENV    ?= kitchen
DATA   ?= data/$(patsubst %-sizes,%,$(ENV)).safetensors
COLLECT_kitchen := --episodes-per-instruction 50
COLLECT_lorel   := --episodes 50000
COLLECT_kitchen-image := --episodes-per-instruction 25
COLLECT_lorel-image := --episodes 3000
# What a table's systems with a camera learn from, beside the data.
SEEN_kitchen-image = $(patsubst %.safetensors,%.features,$(DATA))
SEEN_lorel-image = $(patsubst %.safetensors,%.frames,$(DATA))
# What lints and tests cover; one selection, because each is a build of its own, of tract too: the oracle and the language encoder's engine.
CARGO_FEATURES := lads-sim/report,lads-sim/record,lads-sim/viewer,lads-sim/language
ALL      := --workspace --features $(CARGO_FEATURES)
RUNTIME := -p lads-core -p lads-image -p lads-kernels -p lads-compiler -p lads-host -p lads-import -p lads-pace -p lads-record -p lads-ffi -p lads-cli -p lads-proof
# What is published, in the order of its dependencies; without lads-language, whose engine (tract) needs a newer Rust and builds for minutes.
PUBLISHED := -p lads-kernels -p lads-image -p lads-core -p lads-compiler -p lads-host -p lads-import -p lads-pace -p lads-proof -p lads-record -p lads-ffi -p lads-cli

PREFIX  ?= /usr/local
# A random policy of every family, for tests of all of them.
FAMILIES := target/families

.PHONY: run report compare record viewer say language verify tune mutate frames features test test-torch test-full setup lint test-rust test-runtime test-exporter test-python test-targets wheel sanitize fuzz package msrv deny unused book lock cluster test-cluster collect train export table reference install bench clean help

# Says before a build that takes long what it takes, where nothing of it is there yet: $(call first-build,a crate of it,what,minutes)
first-build = @ls target/release/deps/lib$(1)-*.rlib >/dev/null 2>&1 || echo "The first build of $(2) takes some $(3) minutes of one core; later ones take seconds."

## run: the shipped policy over the paper's seen and unseen instructions; another job of lads-run by JOB, such as JOB="replay flight.mcap"
run: setup
	$(call first-build,lads_sim,the simulator,4)
	cargo run --release -p lads-sim --features camera --bin lads-run -- $(JOB) --model $(MODEL) $(ARGS)

## report: the same with charts, as one HTML page
report: setup
	$(call first-build,kuva,the charts,5)
	cargo run --release -p lads-sim --features report,record --bin lads-run -- --model $(MODEL) --report report.html $(ARGS)

## compare: several policies of one environment on one page, INPUTS="A.onnx B.results.json models/tables.json"; ARGS="--episodes 10"
compare: setup
	$(call first-build,kuva,the charts,5)
	cargo run --release -p lads-sim --features report,record --bin lads-run -- report $(INPUTS) -o report.html $(ARGS)

## record: the first episode of an instruction as episode.gif; ARGS="--instruction kbls"
record: setup
	$(call first-build,gif,the pictures,5)
	cargo run --release -p lads-sim --features report,record --bin lads-run -- record episode.gif --model $(MODEL) --episodes 1 $(ARGS)

## viewer: the policy at real time in a window (X display); ARGS="--instruction kbls --episodes 3"
viewer: setup
	$(call first-build,winit,the window,5)
	cargo run --release -p lads-sim --features viewer --bin lads-run -- view --model $(MODEL) $(ARGS)

## language: the language encoder into the user's cache, once, for `make say`; ENCODER=FOLDER for another BERT-family model
language: $(VENV)/stamp
	$(PY) -m lads_exporter language $(if $(ENCODER),--encoder $(ENCODER))

## say: any sentence to the policy, SAY="open the microwave"; without SAY, every instruction as the language encoder hears it
say: setup language
	$(call first-build,tract_onnx,the language encoder's engine,13)
	cargo run --release -p lads-sim --features language --bin lads-run -- --model $(MODEL) $(if $(SAY),--instruction "$$SAY",--encode-language) $(ARGS)
export SAY

## test: format, lints, documentation and the tests in Rust; needs no PyTorch
test: setup lint test-rust

## test-torch: the tests in Python, of the exporter, of parity and of the package; downloads PyTorch (2.9 GB in all on x86-64 Linux)
test-torch: test-exporter test-python

## test-full: both, the verdict's size with up to 1,000 pairs, every byte of an image of every family flipped, and every command that README.md and
##            the other documents show, as typed, in a copy of the project; hours
test-full: test test-torch $(FAMILIES)/stamp
	cargo test --release -p lads-proof -- --ignored --nocapture size
	LADS_EVERY_BYTE=1 LADS_FAMILIES=$(abspath $(FAMILIES)) cargo test -p lads-tests --test families -- --ignored --nocapture damaged
	cargo test -p lads-tests --test documents -- --ignored --nocapture

## setup: MuJoCo and the simulator's assets into vendor/ (idempotent)
setup:
	$(PYTHON) sim-harness/setup.py

lint: setup
	cargo fmt --all --check
	cargo clippy $(ALL) --all-targets -- -D warnings
	RUSTDOCFLAGS="-D warnings" cargo doc $(ALL) --no-deps --quiet
	# The fuzzers' own workspace has its own lock.
	cargo metadata --locked --quiet --format-version 1 --manifest-path tests/fuzz/Cargo.toml >/dev/null
	# What `make run` builds, without the features of the tests.
	cargo clippy --quiet $(RUNTIME) -p lads-sim -- -D warnings

# tests/tally.sh runs its command, and closes with counts and with what was skipped inside tests that passed, by name.
TALLY := tests/tally.sh

## test-runtime: the runtime's crates alone, without MuJoCo and Python, and without the compiler's own tests, whose oracle (tract) builds for minutes
test-runtime:
	$(TALLY) cargo test $(subst -p lads-compiler,,$(RUNTIME)) -- --show-output

test-rust: setup
	$(TALLY) cargo test $(ALL) --no-fail-fast -- --show-output

## test-targets: the same bits on aarch64, armv7 and Cortex-M under qemu, and the kernels' tests on aarch64; what is missing is named
test-targets:
	$(TALLY) cargo test -p lads-tests --test targets -- --show-output

# Tests of what has unsafe code or untrusted input, in a build with AddressSanitizer, whose run-time library comes with the toolchain,
# and under valgrind, which also sees the use of memory that was never written. Debug assertions and the checks of the preconditions of
# unsafe functions are on in both. valgrind has no AVX-512 and does not flush subnormal numbers; sweeps of safe arithmetic take it too long.
HOST = $(shell rustc --print host-tuple)
SANITIZED = --target $(HOST) --tests -p lads-kernels -p lads-image -p lads-core
# Runs its own binary under valgrind, to count instructions.
COUNTED = --skip every_number_takes_the_same --skip inputs_take_the_same
BOUNDARY = --target $(HOST) -p lads-ffi --test boundary
# Compares a controller's memory byte by byte, with the padding that nothing writes.
PADDED = --skip touches_no_byte
MEMCHECK = CARGO_TARGET_$(shell echo $(HOST) | tr a-z- A-Z_)_RUNNER="valgrind --quiet --error-exitcode=99" PROPTEST_CASES=8

# Small random policies of every family. Where the exporter's environment (PyTorch) is, sanitizers and fuzzers see the images of all of them.
WITH_FAMILIES := $(if $(wildcard $(VENV)/stamp),LADS_FAMILIES=$(abspath $(FAMILIES)))
FAMILY = --target $(HOST) -p lads-tests --test families

$(FAMILIES)/stamp: tests/parity/families.py $(wildcard exporter/lads_exporter/*.py exporter/lads_exporter/*/*.py) | $(VENV)/stamp
	$(PY) tests/parity/families.py $(FAMILIES)
	touch $@

## sanitize: the tests of kernels, core and C boundary with AddressSanitizer, then under valgrind, and the images of every family where the
##           exporter's environment is; some minutes
sanitize: export RUSTC_BOOTSTRAP = 1
sanitize: $(if $(WITH_FAMILIES),$(FAMILIES)/stamp)
	RUSTFLAGS=-Zsanitizer=address cargo test --target-dir target/sanitize $(SANITIZED) -- $(COUNTED)
	RUSTFLAGS=-Zsanitizer=address cargo test --target-dir target/sanitize $(BOUNDARY)
	$(MEMCHECK) cargo test --target-dir target/sanitize/plain $(SANITIZED) -- $(COUNTED) --skip subnormal_numbers_are_zero --skip as_exact_as
	$(MEMCHECK) cargo test --target-dir target/sanitize/plain $(BOUNDARY) -- $(PADDED)
ifneq ($(WITH_FAMILIES),)
	$(WITH_FAMILIES) RUSTFLAGS=-Zsanitizer=address cargo test --target-dir target/sanitize $(FAMILY) -- --ignored --skip damaged
else
	@echo "skipped: images of every family, which need the exporter's environment: make $(VENV)/stamp"
endif

# cargo-fuzz and a nightly toolchain are needed; what is found lies in tests/fuzz/artifacts.
FUZZ_SECONDS ?= 60

## fuzz: hostile images, bundles and imports, FUZZ_SECONDS=60 each; needs a nightly toolchain and cargo-fuzz
fuzz: $(if $(WITH_FAMILIES),$(FAMILIES)/stamp)
	cd tests && $(WITH_FAMILIES) cargo +nightly fuzz run image -- -max_len=256 -max_total_time=$(FUZZ_SECONDS)
	cd tests && $(WITH_FAMILIES) cargo +nightly fuzz run bundle -- -max_total_time=$(FUZZ_SECONDS)
	cd tests && cargo +nightly fuzz run import -- -max_total_time=$(FUZZ_SECONDS) -timeout=60

## package: the crates that are published, packed as a registry would get them, without building them; PACKAGE_ARGS= builds them from the packages
PACKAGE_ARGS ?= --no-verify
package:
	cargo package --locked --allow-dirty $(PACKAGE_ARGS) $(PUBLISHED)

## msrv: the published crates build with the Rust that their `rust-version` names; needs that toolchain
MSRV = $(shell sed -n 's/^rust-version = "\(.*\)"/\1/p' Cargo.toml)
msrv:
	cargo +$(MSRV) check --locked $(PUBLISHED)

## deny: licences, bans and sources of the dependencies by deny.toml; needs cargo-deny. DENY_ARGS=advisories asks for known faults
DENY_ARGS ?= licenses bans sources
deny:
	cargo deny check $(DENY_ARGS)

## unused: dependencies that nothing uses; needs cargo-machete
unused:
	cargo machete

## book: docs/ as pages to read in a browser, into target/book; needs mdbook
book:
	mdbook build

PIP = $(PY) -m pip install --quiet --disable-pip-version-check

# The stamp makes the environment anew whenever what belongs into it changes.
$(VENV)/stamp: exporter/pyproject.toml exporter/requirements.lock exporter/encoder.lock
	$(PYTHON) -m venv $(VENV)
	$(PIP) --require-hashes -r exporter/requirements.lock
	$(PIP) --require-hashes --no-deps -r exporter/encoder.lock
	$(PIP) --no-deps --no-build-isolation -e exporter
	touch $@

# Tables on more than one machine need Ray, and nothing else does.
$(VENV)/cluster-stamp: $(VENV)/stamp exporter/cluster.lock
	$(PIP) --require-hashes -r exporter/cluster.lock
	touch $@

## cluster: Ray into the project's environment (250 MB), for tables on more than one machine, docs/cluster.md
cluster: $(VENV)/cluster-stamp

COMPILE = ../$(VENV)/bin/uv pip compile --universal --python-version 3.11 --generate-hashes --no-header --no-annotate --quiet --upgrade
# What the extra for clusters asks for, one requirement a line.
RAY = import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]["cluster"], sep="\n")

## lock: exporter/requirements.lock and cluster.lock anew from the ranges of exporter/pyproject.toml, with the newest versions inside them
lock: $(VENV)/stamp
	$(PIP) uv==0.13.9
	cd exporter && $(COMPILE) pyproject.toml --extra test --output-file ../target/requirements.txt
	cd exporter && ../$(PY) -c '$(RAY)' | $(COMPILE) - --constraints ../target/requirements.txt --output-file ../target/cluster.txt
	for name in requirements cluster; do \
		(sed -n '1,/^[^#]/{/^#/p}' exporter/$$name.lock; cat target/$$name.txt) > target/$$name.lock && mv target/$$name.lock exporter/$$name.lock || exit 1; \
	done

# One process a core, up to what memory bears; who is done first takes tests of the others.
WORKERS = -n auto --maxprocesses 6 --dist worksteal

test-exporter: setup $(VENV)/stamp
	# With the examples, cargo counts in the dependencies of tests, and what `make test` has built serves here.
	cargo build $(ALL) --bins --examples
	$(TALLY) $(PY) -m pytest -rs $(WORKERS) exporter/tests tests/parity

## test-cluster: tables on Ray clusters of two nodes on this machine, one of which is lost; installs Ray; some minutes
test-cluster: $(VENV)/cluster-stamp
	$(TALLY) $(PY) -m pytest -rs exporter/tests/test_cluster.py exporter/tests/test_shards.py

# An environment of its own: a wheel needs no PyTorch. The pin is that of runtime/python/pyproject.toml.
MATURIN := target/maturin
$(MATURIN)/stamp: runtime/python/pyproject.toml
	$(PYTHON) -m venv $(MATURIN)
	$(MATURIN)/bin/python -m pip install --quiet --disable-pip-version-check maturin==1.16.0
	touch $@

## wheel: the Python package `lads` for this platform, into target/wheels
wheel: $(MATURIN)/stamp
	$(call first-build,pyo3,the package,3)
	rm -f target/wheels/lads-*.whl
	$(MATURIN)/bin/python -m maturin build --quiet --release --manifest-path runtime/python/Cargo.toml --out target/wheels

## test-python: the wheel in a fresh environment with nothing else, then the package's tests and examples in the project's
test-python: setup wheel $(VENV)/stamp
	rm -rf target/fresh
	$(PYTHON) -m venv target/fresh
	target/fresh/bin/python -m pip install --quiet --disable-pip-version-check target/wheels/lads-*.whl
	target/fresh/bin/python -X faulthandler runtime/python/tests/fresh.py models/kitchen-small.onnx
	target/fresh/bin/python -m lads self-test models/kitchen-small.onnx
	$(PIP) --no-deps --force-reinstall target/wheels/lads-*.whl
	# What the tests and the examples need besides, by the installed wheel's own pins.
	$(PIP) 'lads[test,examples]'
	$(TALLY) $(PY) -m pytest -rs $(WORKERS) runtime/python/tests

## collect: demonstrations into data/ENV.safetensors; ENV=kitchen (scripted, of the 22 seen instructions), lorel (random, labelled), or kitchen-image and
##         lorel-image (as many as are drawn)
collect: setup
	$(call first-build,lads_sim,the simulator,4)
	cargo run --release -p lads-sim --bin lads-collect -- --env $(ENV:-image=) $(COLLECT_$(ENV)) -o data/$(ENV).safetensors

## frames: what the environment's camera sees in every state of $(DATA), for settings on images (ENV=lorel DATA=data/lorel.safetensors); about
##         20 ms each on one core, and the same command goes on where it was stopped. Then: make train ENV=lorel-image DATA=... FRAMES=...
frames: setup
	$(call first-build,lads_sim,the simulator,4)
	cargo run --release -p lads-sim --features camera --bin lads-run -- frames $(DATA) -o $(DATA:.safetensors=.frames)

## features: what the frozen encoder of exporter/configs/$(ENV).toml (ENV=kitchen-image) makes of every state of $(DATA); 70 ms each on one core, and
##           the same command goes on where it was stopped. Then: make train ENV=kitchen-image DATA=... FEATURES=...
features: setup $(VENV)/stamp
	$(call first-build,lads_sim,the simulator,4)
	cargo build --release -p lads-sim --features camera --bin lads-run
	$(PY) -m lads_exporter features --config exporter/configs/$(ENV).toml --data $(DATA) -o $(DATA:.safetensors=.features)

## train: the shipped policy from data/ENV.safetensors into runs/ENV; one thread, because sums depend on their number.
##        A smaller one for microcontrollers: make train export ENV=kitchen-small DATA=data/kitchen.safetensors
train: $(VENV)/stamp
	$(PY) -m lads_exporter train --config exporter/configs/$(ENV).toml --data $(DATA) $(if $(FRAMES),--frames $(FRAMES)) $(if $(FEATURES),--features $(FEATURES)) --out runs/$(ENV) --threads 1

## export: runs/ENV into models/ENV.onnx
export: $(VENV)/stamp
	$(PY) -m lads_exporter export --run runs/$(ENV) -o models/$(ENV).onnx

## table: every system of the paper's tables, ENV=kitchen, lorel, kitchen-image, lorel-image or kitchen-sizes (Figure 6): trained, exported, evaluated, into
##        models/TABLES.md; hours, and the same command goes on where it was stopped. TABLE_ARGS="--jobs 2" trains two at a time, "--device cuda" on a
##        GPU, "--engine ray" on a cluster (docs/cluster.md)
table: setup $(VENV)/stamp $(DATA) $(SEEN_$(ENV))
	$(call first-build,lads_sim,the simulator,4)
	cargo build --release -p lads-sim $(if $(filter %-image,$(ENV)),--features camera) --bin lads-run
	$(PY) -m lads_exporter table exporter/tables/$(ENV).toml --data $(DATA) $(TABLE_ARGS)

%.frames: | %.safetensors
	$(MAKE) frames DATA=$*.safetensors

%.features: | %.safetensors
	$(MAKE) features DATA=$*.safetensors

$(DATA):
	$(MAKE) collect ENV=$(patsubst %-sizes,%,$(ENV))

## reference: the policy of $(MODEL) in PyTorch and the official environment, 20 episodes of each instruction, for `lads-run verify`;
##         RUN=runs/$(ENV) takes the weights from the training's checkpoint, as the shipped references do, so that a fault of the export would show;
##         ARGS="--noise none" on the LOReL table; a policy with a camera needs the built program, which draws for it (--lads-run)
reference: $(VENV)/stamp
	$(PY) -m lads_exporter reference --model $(MODEL) -o $(MODEL:.onnx=.reference.json) $(if $(RUN),--run $(RUN)) $(ARGS)

## verify: is the compiled policy the reference's? Fails unless EQUIVALENT; `lads-run verify` itself exits with 0, 1 DIFFERENT or 3 INCONCLUSIVE
verify: setup
	$(call first-build,lads_sim,the simulator,4)
	cargo run --release -p lads-sim --features camera --bin lads-run -- verify --model $(MODEL) $(ARGS)

## tune: the smallest weights and caches that keep every plan of $(MODEL)'s reference, written into the bundle; ARGS="-o FILE" leaves it as it is
tune: setup
	$(call first-build,lads_sim,the simulator,4)
	cargo run --release -p lads-sim --features camera --bin lads-run -- tune --model $(MODEL) $(ARGS)

## mutate: changes of every kind to $(MODEL), what each moves, what its verification says and what is left of its success; an hour. ARGS="-o rows.md"
##         writes the row of each; ARGS="--every 3 --run-every 8" asks and runs fewer episodes, minutes
mutate: setup
	$(call first-build,lads_sim,the simulator,4)
	cargo run --release -p lads-sim --example mutate -- $(MODEL) $(ARGS)

# OpenVINO is a peer of the benchmarks only; where it does not install, the page says so.
$(VENV)/bench-stamp: $(VENV)/stamp
	-$(PIP) openvino==2026.4.1
	touch $@

## install: liblads.a, lads.h, lads.hpp, and their CMake and pkg-config files, into PREFIX (/usr/local)
install:
	runtime/ffi/install.sh "$(PREFIX)"

## bench: everything measured, beside what one would use instead, into benches/RESULTS.md; on a quiet machine, twelve minutes after the build
bench: setup $(VENV)/bench-stamp
	$(PYTHON) benches/setup.py
	# What an earlier run has left is not of this one.
	rm -rf target/criterion
	cargo bench -p lads-benches --benches -- --noplot --warm-up-time 0.3 --measurement-time 1
	cargo build --profile bench -p lads-benches --features results
	target/release/results $(BENCH_ARGS)

clean:
	cargo clean
	rm -rf $(VENV) vendor

help:
	@sed -n 's/^## //p' Makefile
