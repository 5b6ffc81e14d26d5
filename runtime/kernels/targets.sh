#!/bin/sh
# The kernels' own tests, against their twins and bit for bit between instruction sets, on aarch64 under qemu: on a CPU with the
# dot product of bytes and on one without it. What is missing is named, and then nothing is tested.
# usage: runtime/kernels/targets.sh
# Needs aarch64-linux-gnu-gcc, qemu-aarch64 and Rust's standard library for the target (rustup target add aarch64-unknown-linux-gnu).
set -eu
root=$(cd "$(dirname "$0")/../.." && pwd)
target=aarch64-unknown-linux-gnu
for tool in aarch64-linux-gnu-gcc qemu-aarch64; do
    command -v "$tool" >/dev/null || { echo "skipped: $tool is not installed"; exit 0; }
done
sysroot=$("${RUSTC:-rustc}" --print sysroot)
ls "$sysroot/lib/rustlib/$target/lib"/libstd-*.rlib >/dev/null 2>&1 ||
    { echo "skipped: $target: this Rust toolchain has no standard library for it; rustup target add $target"; exit 0; }
cd "$root"
for cpu in max cortex-a53; do
    echo "aarch64, $cpu:"
    CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=aarch64-linux-gnu-gcc \
        CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_RUNNER="qemu-aarch64 -L /usr/aarch64-linux-gnu -cpu $cpu" \
        CARGO_TARGET_DIR=$root/target/targets \
        "${CARGO:-cargo}" test --quiet --locked --release -p lads-kernels --target $target \
        --lib --test attention --test conv_integers --test images --test integers --test linear --test stored --test twins
done
