# `make demo`: a map in a few minutes, without any recording. `make test`, `make check`: what the project asks of itself.
# `make gpu-static`: what compilers for GPUs make of the shaders.

CARGO_HOME ?= $(HOME)/.cargo
# Where rustup puts cargo, in case it was installed just now.
export PATH := $(CARGO_HOME)/bin:$(PATH)

.PHONY: demo test check gpu-static lane-widths setup build quality-fixture

demo: build
	target/release/keysplat demo --out out/demo

build: setup
	cargo build --release

test: setup
	@scripts/test.sh

# Rewrites the expected figures of the quality gate; one at a time, for they share a file.
quality-fixture: setup
	KEYSPLAT_REQUIRE=adapter,data KEYSPLAT_UPDATE_QUALITY=1 cargo test --release --test program -- quality --test-threads 1

check: setup
	cargo fmt --check
	cargo clippy --release --all-targets -- -D warnings
	RUSTDOCFLAGS="-D warnings" cargo doc --release --no-deps
	command -v cargo-deny >/dev/null || cargo install --locked cargo-deny
	cargo deny --locked check licenses bans sources

gpu-static: setup
	scripts/gpu-static.sh

# The GPU's tests with four and with sixteen lanes of Mesa's software adapter; its own width is that of the processor.
lane-widths: setup
	LP_NATIVE_VECTOR_WIDTH=128 KEYSPLAT_REQUIRE=adapter cargo test --release --test gpu
	LP_NATIVE_VECTOR_WIDTH=512 KEYSPLAT_REQUIRE=adapter cargo test --release --test gpu

setup:
	@scripts/setup.sh
