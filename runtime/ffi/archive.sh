#!/bin/sh
# Builds liblads.a: one object that exports lads_* and nothing else, and that cannot panic.
# usage: runtime/ffi/archive.sh <output file> [<target>]
# LADS_OPS says which groups of operations a policy needs; without it all are in, and every image runs. It is a list of features of
# the crate lads-ffi, separated by commas (Cargo.toml names them); an image that needs what was left out is refused when it is opened:
#     LADS_OPS=lads runtime/ffi/archive.sh build/liblads.a                   the family of the shipped policies, as images with 32 bits
#     LADS_OPS=lads,integer-weights,integer-cache runtime/ffi/archive.sh ... the same with weights of 16 and 8 bits and a cache of 8, as the kitchen is tuned
# Needs cargo and binutils; for another target set LD, OBJCOPY, AR and NM to its tools, and CARGO_FLAGS to what cargo needs for it.
set -eu
output=$1
target=${2:-}
root=$(cd "$(dirname "$0")/../.." && pwd -P)
: "${LD:=ld}" "${OBJCOPY:=objcopy}" "${AR:=ar}" "${NM:=nm}" "${CARGO:=cargo}"

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT INT TERM
case $output in /*) ;; *) output=$PWD/$output ;; esac
mkdir -p "$(dirname "$output")"

features=archive$(echo ",${LADS_OPS-default}" | sed 's:,\([^,]\):,lads-ffi/\1:g')
# A folder for each choice of operations: another archive that is built at the same time is not mistaken for this one.
choice=${LADS_OPS+only-$LADS_OPS}
build=${CARGO_TARGET_DIR:-$root/target}/archive-build/${choice:-all}
# shellcheck disable=SC2086
(cd "$root" && "$CARGO" rustc --quiet --locked ${CARGO_FLAGS:-} -p lads-static --profile archive --features "$features" \
    --crate-type staticlib --target-dir "$build" ${target:+--target "$target"})

# Some targets' objects carry their bitcode too; binutils with a plugin for it would read that instead.
"$OBJCOPY" --remove-section=.llvmbc --remove-section=.llvmcmd "$build/${target:+$target/}archive/liblads_static.a" "$work/whole.a"

# Beside the crate's own object, a staticlib carries all of Rust's compiler builtins; the linker takes from it what is used.
# What only a panic would reach is dropped: no root leads there.
roots=$("$NM" --defined-only "$work/whole.a" 2>/dev/null |
    sed -n 's/^[0-9a-f]* T \(lads_[a-z0-9_]*\)$/\1/p' | sort -u)
[ -n "$roots" ] || { echo "archive.sh: the library exports no lads_ function" >&2; exit 1; }
# shellcheck disable=SC2046
"$LD" -r --gc-sections $(printf -- '-u %s ' $roots) -o "$work/lads.o" "$work/whole.a"
"$OBJCOPY" --strip-debug --wildcard --keep-global-symbol='lads_*' "$work/lads.o"

if "$NM" "$work/lads.o" | grep -E 'lads_a_panic_is_reachable|panicking|rust_begin_unwind' >"$work/panics"; then
    echo "archive.sh: a panic is reachable:" >&2
    cat "$work/panics" >&2
    exit 1
fi
rm -f "$work/liblads.a"
"$AR" rcs "$work/liblads.a" "$work/lads.o"
mv "$work/liblads.a" "$output"
