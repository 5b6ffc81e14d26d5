#!/bin/sh
# The self-test of a small policy on other targets under qemu, bit for bit as on this machine. What is missing is skipped and named. Of the
# program for Cortex-M it also says what it takes: flash, RAM, stack, and the instructions of a control step (docs/firmware.md). LADS_OPS as for
# runtime/ffi/archive.sh. With the images of a biped's two policies, its control loop of three seconds, in C and in Rust, runs on the targets with
# Linux too. The processors that qemu stands for there have nothing beyond their target's baseline.
# usage: runtime/ffi/examples/targets/run.sh <image.c> [<stand.lads> <walk.lads>]
#        image.c: lads compile models/kitchen-small.onnx --emit-c image.c; the others: docs/import.md
# Needs, per target, the C compiler and the qemu named below, and Rust's core for it: the target added to a toolchain
# (rustup target add), or a toolchain with rust-src, of which core is built on the way. Every toolchain on PATH and of rustup is tried, but
# for those that are older than the project's rust-version.
set -eu
[ $# -eq 1 ] || [ $# -eq 3 ] || { echo "usage: run.sh <image.c> [<stand.lads> <walk.lads>]" >&2; exit 2; }
here=$(cd "$(dirname "$0")" && pwd)
root=$(cd "$here/../../../.." && pwd)
image=$1 stand=${2:-} walk=${3:-}
name=$(sed -n 's/^extern const unsigned char \([a-z0-9_]*\)\[[0-9]*\];$/\1/p' "$image" | head -n 1)
bytes=$(sed -n 's/^extern const unsigned char [a-z0-9_]*\[\([0-9]*\)\];$/\1/p' "$image" | head -n 1)
[ -n "$name" ] || { echo "run.sh: $image: not a source of lads compile --emit-c" >&2; exit 2; }
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT INT TERM
flags="-std=gnu11 -O2 -Wall -Wextra -ffp-contract=off -DIMAGE=$name -DIMAGE_BYTES=$bytes -I$here/../../include -Wl,--gc-sections -Wl,-z,noexecstack"

have() {
    for tool in "$@"; do
        command -v "$tool" >/dev/null || { echo "skipped: $tool is not installed"; return 1; }
    done
}
oldest=$(sed -n 's/^rust-version = "\(.*\)"$/\1/p' "$root/Cargo.toml")
compilers() {
    {
        echo "${RUSTC:-rustc}"
        echo "$PATH" | tr ':' '\n' | sed 's:$:/rustc:'
        echo "${RUSTUP_HOME:-$HOME/.rustup}"/toolchains/*/bin/rustc | tr ' ' '\n'
    } | while read -r compiler; do
        version=$("$compiler" --version 2>/dev/null | sed -n 's/^rustc \([0-9.]*\).*/\1/p')
        [ -z "$version" ] || [ "$(printf '%s\n' "$oldest" "$version" | sort -V | head -n 1)" != "$oldest" ] || echo "$compiler"
    done
}
# toolchain <target>: finds a compiler that can, as $compiler with $bootstrap and $build_core
toolchain() {
    for compiler in $(compilers); do
        sysroot=$("$compiler" --print sysroot 2>/dev/null) || continue
        if [ -d "$sysroot/lib/rustlib/$1/lib" ]; then
            bootstrap=0 build_core=
            return
        fi
    done
    for compiler in $(compilers); do
        sysroot=$("$compiler" --print sysroot 2>/dev/null) || continue
        if [ -d "$sysroot/lib/rustlib/src/rust/library/core" ]; then
            bootstrap=1 build_core=-Zbuild-std=core
            return
        fi
    done
    echo "skipped: $1: no Rust toolchain of $oldest or later has it; rustup target add $1, or install a rust-src (rustup component add rust-src)"
    return 1
}
# archive <target> <prefix of its binutils>: builds the library, as for this machine, into $archive
archive() {
    archive=$work/$1.a
    RUSTC=$compiler RUSTC_BOOTSTRAP=$bootstrap CARGO_FLAGS=$build_core CARGO_TARGET_DIR=$root/target/targets \
        LD=$2ld OBJCOPY=$2objcopy AR=$2ar NM=$2nm "$root/runtime/ffi/archive.sh" "$archive" "$1"
}
same() {
    printf '%s: ' "$1"
    if [ "$(echo "$2" | grep -v '^stack\|^step')" = "$expected" ]; then
        echo "the same bits$(echo "$2" | sed -n 's/^st\(ack\|ep\)/; &/p' | tr -d '\n')"
    else
        echo "differs: $2"
        exit 1
    fi
}
# loop <compiler> <archive> <how to run it>...: what the biped's loop in C says
loop() {
    compiler_of_c=$1 library=$2
    shift 2
    # shellcheck disable=SC2086
    "$compiler_of_c" -std=c11 $linked -O2 -Wall -Wextra -I"$here/../../include" "$here/../c/biped.c" "$library" -lm -o "$work/biped"
    "$@" "$work/biped" "$stand" "$walk" 150
}
# biped <target> <prefix of its binutils> <how to run it>...: the loop in C, and the one in Rust where the toolchain has the target's standard library
biped() {
    [ -n "$stand" ] || return 0
    target=$1 prefix=$2
    shift 2
    linked=-static
    [ "$(loop "${prefix}gcc" "$archive" "$@")" = "$walked" ] || { echo "biped in C, $target: differs"; exit 1; }
    echo "biped in C, $target: the same bits"
    std=$("$compiler" --print sysroot)/lib/rustlib/$target/lib
    ls "$std"/libstd-*.rlib >/dev/null 2>&1 || { echo "skipped: biped in Rust, $target: no standard library; rustup target add $target"; return 0; }
    linker=CARGO_TARGET_$(echo "$target" | tr 'a-z-' 'A-Z_')_LINKER
    (cd "$root" && env "$linker=${prefix}gcc" RUSTC="$compiler" "${CARGO:-cargo}" build --quiet --locked -p lads-host --example biped --target "$target" --target-dir target/targets)
    said=$("$@" "$root/target/targets/$target/debug/examples/biped" "$stand" "$walk" 150 --fast)
    [ "$(echo "$said" | grep '^digest')" = "$(echo "$walked" | grep '^digest')" ] || { echo "biped in Rust, $target: differs: $said"; exit 1; }
    echo "biped in Rust, $target: the same bits"
}

"$root/runtime/ffi/archive.sh" "$work/liblads.a"
# shellcheck disable=SC2086
cc $flags "$here/selftest.c" "$image" "$work/liblads.a" -o "$work/host"
expected=$("$work/host")
echo "$expected"
if [ -n "$stand" ]; then
    linked=
    walked=$(loop cc "$work/liblads.a" env)
    echo "biped: $(echo "$walked" | tail -n 1)"
fi

if have aarch64-linux-gnu-gcc qemu-aarch64 && toolchain aarch64-unknown-linux-gnu; then
    archive aarch64-unknown-linux-gnu aarch64-linux-gnu-
    # shellcheck disable=SC2086
    aarch64-linux-gnu-gcc -static $flags "$here/selftest.c" "$image" "$archive" -o "$work/aarch64"
    for cpu in max cortex-a53; do
        same "aarch64 $cpu" "$(qemu-aarch64 -cpu "$cpu" "$work/aarch64")"
    done
    biped aarch64-unknown-linux-gnu aarch64-linux-gnu- qemu-aarch64 -L /usr/aarch64-linux-gnu -cpu cortex-a53
fi
if have arm-linux-gnueabihf-gcc qemu-arm && toolchain armv7-unknown-linux-gnueabihf; then
    archive armv7-unknown-linux-gnueabihf arm-linux-gnueabihf-
    # shellcheck disable=SC2086
    arm-linux-gnueabihf-gcc -static $flags "$here/selftest.c" "$image" "$archive" -lm -o "$work/armv7"
    same armv7 "$(qemu-arm "$work/armv7")"
    biped armv7-unknown-linux-gnueabihf arm-linux-gnueabihf- qemu-arm -L /usr/arm-linux-gnueabihf -cpu cortex-a7
fi
if have arm-none-eabi-gcc qemu-system-arm && toolchain thumbv7em-none-eabihf; then
    archive thumbv7em-none-eabihf arm-none-eabi-
    # shellcheck disable=SC2086
    arm-none-eabi-gcc $flags -ffreestanding -fno-builtin -nostdlib -mthumb -mcpu=cortex-m4 -mfloat-abi=hard -mfpu=fpv4-sp-d16 \
        "$here/selftest.c" "$here/startup.c" "$image" "$archive" -lgcc -T "$here/mps2.ld" -o "$work/cortex"
    arm-none-eabi-size "$work/cortex" | awk -v image="$bytes" \
        'END { print "Cortex-M: flash " $1 + $2 " bytes, of which the image " image "; RAM " $2 + $3 " bytes, to which the stack comes" }'
    for board in mps2-an386 mps2-an500; do
        same "$board" "$(qemu-system-arm -machine $board -icount shift=0 -nographic -semihosting -kernel "$work/cortex" 2>&1)"
    done
fi
