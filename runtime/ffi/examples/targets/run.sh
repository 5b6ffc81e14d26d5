#!/bin/sh
# The self-test of a small policy on other targets under qemu, bit for bit as on this machine. What is missing is skipped and named.
# usage: runtime/ffi/examples/targets/run.sh <image.c> <bytes of the image>     image.c: lads compile small.onnx --emit-c policy.c
# Needs, per target, the compiler and qemu named below, and core: either the target added to the toolchain, or rust-src and
# RUSTC_BOOTSTRAP=1 (Debian's rustc-web with rust-web-src does: RUSTC=/usr/bin/rustc RUSTC_BOOTSTRAP=1).
set -eu
[ $# -eq 2 ] || { echo "usage: run.sh <image.c> <bytes>" >&2; exit 2; }
here=$(cd "$(dirname "$0")" && pwd)
root=$(cd "$here/../../../.." && pwd)
image=$1
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT INT TERM
flags="-std=gnu11 -O2 -ffp-contract=off -DIMAGE_BYTES=$2 -I$here/../../include -Wl,--gc-sections"

# archive <target>: builds the library into $archive
archive() {
    sysroot=$("${RUSTC:-rustc}" --print sysroot)
    if [ -d "$sysroot/lib/rustlib/$1" ]; then
        std=
    elif [ -n "${RUSTC_BOOTSTRAP:-}" ] && [ -d "$sysroot/lib/rustlib/src/rust/library" ]; then
        std=-Zbuild-std=core
    else
        echo "skipped: $1: neither the target nor rust-src is there"
        return 1
    fi
    # shellcheck disable=SC2086
    (cd "$root" && cargo rustc --quiet $std -p lads-ffi --profile archive --features static-library --crate-type staticlib \
        --target-dir "$root/target/archive-build" --target "$1")
    archive=$root/target/archive-build/$1/archive/liblads_ffi.a
}
have() {
    for tool in "$@"; do
        command -v "$tool" >/dev/null || { echo "skipped: $tool is not installed"; return 1; }
    done
}
same() {
    printf '%s: ' "$1"
    if [ "$2" = "$expected" ]; then echo "the same bits"; else echo "differs: $2"; exit 1; fi
}

"$root/runtime/ffi/archive.sh" "$work/liblads.a"
# shellcheck disable=SC2086
cc $flags "$here/selftest.c" "$image" "$work/liblads.a" -o "$work/host"
expected=$("$work/host")
echo "$expected"

if have aarch64-linux-gnu-gcc qemu-aarch64 && archive aarch64-unknown-linux-gnu; then
    # shellcheck disable=SC2086
    aarch64-linux-gnu-gcc -static $flags "$here/selftest.c" "$image" "$archive" -o "$work/aarch64"
    same aarch64 "$(qemu-aarch64 "$work/aarch64")"
fi
if have arm-none-eabi-gcc qemu-system-arm && archive thumbv7em-none-eabihf; then
    # shellcheck disable=SC2086
    arm-none-eabi-gcc $flags -ffreestanding -fno-builtin -nostdlib -mthumb -mcpu=cortex-m4 -mfloat-abi=hard -mfpu=fpv4-sp-d16 \
        "$here/selftest.c" "$here/startup.c" "$image" "$archive" -lgcc -T "$here/mps2.ld" -o "$work/cortex"
    for board in mps2-an386 mps2-an500; do
        same "$board" "$(qemu-system-arm -machine $board -nographic -semihosting -kernel "$work/cortex")"
    done
fi
