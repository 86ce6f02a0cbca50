#!/usr/bin/env bash
# Builds simd_paths.cpp with the rasterizer's sources and runs it: without arguments for this processor, with "neon" for
# AArch64 by a cross compiler, under QEMU (Debian: g++-aarch64-linux-gnu qemu-user).
set -euo pipefail
cd "$(dirname "$0")/../.."

target=${1:-native}
flags=(-std=c++20 -O2 -ffp-contract=off -fno-math-errno -fno-trapping-math -Icsrc)
runner=()
machine=$(uname -m)
if [ "$target" = neon ]; then
    CXX=${CROSS_CXX:-aarch64-linux-gnu-g++}
    machine=aarch64
    flags+=(-static)
    [ "$(uname -m)" = aarch64 ] || runner=("${QEMU:-qemu-aarch64}")
fi
CXX=${CXX:-c++}
build=build/native-$target
mkdir -p "$build"

avx512="-mavx512f -mavx512dq -mavx512bw -mavx512vl -mavx2 -mfma -mprefer-vector-width=512"
case $machine in
    x86_64) define=-DETSPLAT_X86=1 paths=("plain:" "avx2:-mavx2 -mfma" "avx512:$avx512") ;;
    aarch64 | arm64) define=-DETSPLAT_ARM64=1 paths=("plain:" "neon:") ;;
    *) define=-DETSPLAT_PLAIN=1 paths=("plain:") ;;
esac

objects=()
compile() { # object, source, flags...
    local object=$build/$1 source=$2
    shift 2
    "$CXX" "${flags[@]}" "$define" "$@" -c "$source" -o "$object"
    objects+=("$object")
}
for path in "${paths[@]}"; do
    name=${path%%:*}
    for source in csrc/cpu/simd/*_kernels.cpp; do
        # shellcheck disable=SC2086  # the flags of a path are words
        compile "$(basename "$source" .cpp)_$name.o" "$source" "-DETSPLAT_SIMD=$name" ${path#*:}
    done
done
for source in csrc/cpu/raster.cpp csrc/cpu/raster_*.cpp csrc/cpu/{parallel,instruction_set}.cpp tests/native/simd_paths.cpp; do
    compile "$(basename "$source" .cpp).o" "$source"
done
"$CXX" "${flags[@]}" "${objects[@]}" -o "$build/simd_paths" -lpthread
"${runner[@]}" "$build/simd_paths"
