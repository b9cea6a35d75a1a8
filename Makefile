# `make demo`: a map in a few minutes, without any recording. `make test`, `make check`: what the project asks of itself.

CARGO_HOME ?= $(HOME)/.cargo
# Where rustup puts cargo, in case it was installed just now.
export PATH := $(CARGO_HOME)/bin:$(PATH)

.PHONY: demo test check setup build

demo: build
	target/release/keysplat demo --out out/demo

build: setup
	cargo build --release

test: setup
	@scripts/test.sh

check: setup
	cargo fmt --check
	cargo clippy --release --all-targets -- -D warnings
	RUSTDOCFLAGS="-D warnings" cargo doc --release --no-deps

setup:
	@scripts/setup.sh
