#!/bin/sh
# Installs liblads.a, its headers, and what CMake and pkg-config need to find them.
# usage: runtime/ffi/install.sh <prefix> [<target>]
# Nothing is put into the prefix before everything is built.
set -eu
[ $# -ge 1 ] || { echo "usage: runtime/ffi/install.sh <prefix> [<target>]" >&2; exit 2; }
prefix=$1
here=$(cd "$(dirname "$0")" && pwd -P)
case $prefix in /*) ;; *) prefix=$PWD/$prefix ;; esac

version=$(sed -n 's/^version = "\(.*\)"/\1/p' "$here/../../Cargo.toml" | head -n 1)
major=${version%%.*}
minor=${version#*.}
minor=${minor%%.*}

stage=$(mktemp -d)
trap 'rm -rf "$stage"' EXIT INT TERM
"$here/archive.sh" "$stage/liblads.a" ${2:+"$2"}
for file in lads.pc ladsConfig.cmake ladsConfigVersion.cmake; do
    sed -e "s|@PREFIX@|$prefix|" -e "s|@VERSION@|$version|" -e "s|@MAJOR@|$major|" -e "s|@MINOR@|$minor|" \
        "$here/package/$file.in" >"$stage/$file"
done

put() {
    mkdir -p "$prefix/$2"
    install -m 644 "$1" "$prefix/$2/"
}
put "$stage/liblads.a" lib
put "$here/include/lads.h" include
put "$here/include/lads.hpp" include
put "$stage/lads.pc" lib/pkgconfig
put "$stage/ladsConfig.cmake" lib/cmake/lads
put "$stage/ladsConfigVersion.cmake" lib/cmake/lads
echo "lads $version is in $prefix"
