#!/usr/bin/env bash
# Builds a program with the rasterizer's sources and runs it.
#
#   run.sh                  simd_paths.cpp for this processor
#   run.sh neon             the same for AArch64 by a cross compiler, under QEMU (Debian: g++-aarch64-linux-gnu qemu-user)
#   run.sh races [SECONDS]  races.cpp under ThreadSanitizer; a planted race must be found first
#   run.sh forks [SECONDS]  races.cpp without, where no child may hang
set -euo pipefail
cd "$(dirname "$0")/../.."

target=${1:-native}
program=simd_paths
flags=(-std=c++20 -O2 -ffp-contract=off -fno-math-errno -fno-trapping-math -Icsrc)
runner=()
machine=$(uname -m)
case $target in
    neon)
        CXX=${CROSS_CXX:-aarch64-linux-gnu-g++}
        machine=aarch64
        flags+=(-static)
        [ "$(uname -m)" = aarch64 ] || runner=("${QEMU:-qemu-aarch64}")
        ;;
    forks)
        program=races
        machine=plain
        flags+=(-O0 -g)
        ;;
    races)
        program=races
        machine=plain # one instruction set will do: threads share nothing within a tile
        flags+=(-O0 -g -fsanitize=thread) # optimised, the tile loops compile for minutes
        # Children of a process with threads start threads of their own. Address layouts of newer kernels: see setarch.
        export TSAN_OPTIONS="die_after_fork=0 halt_on_error=1 ${TSAN_OPTIONS:-}"
        runner=(setarch --addr-no-randomize)
        ;;
esac
CXX=${CXX:-c++}
build=build/native-$target
mkdir -p "$build"

avx512="-mavx512f -mavx512dq -mavx512bw -mavx512vl -mavx2 -mfma -mprefer-vector-width=512 -mtune=icelake-server"
case $machine in
    x86_64) define=-DETSPLAT_X86=1 paths=("plain:" "avx2:-mavx2 -mfma" "avx512:$avx512") ;;
    aarch64 | arm64) define=-DETSPLAT_ARM64=1 paths=("plain:" "neon:") ;;
    *) define=-DETSPLAT_PLAIN=1 paths=("plain:") ;;
esac

objects=() compilers=()
compile() { # object, source, flags...
    local object=$build/$1 source=$2
    shift 2
    "$CXX" "${flags[@]}" "$define" "$@" -c "$source" -o "$object" &
    compilers+=($!)
    objects+=("$object")
}
for path in "${paths[@]}"; do
    name=${path%%:*}
    for source in csrc/cpu/simd/*_kernels.cpp; do
        # shellcheck disable=SC2086  # the flags of a path are words
        compile "$(basename "$source" .cpp)_$name.o" "$source" "-DETSPLAT_SIMD=$name" ${path#*:}
    done
done
for source in csrc/cpu/raster.cpp csrc/cpu/raster_*.cpp csrc/cpu/{array_scans,parallel,pool,instruction_set}.cpp "tests/native/$program.cpp"; do
    compile "$(basename "$source" .cpp).o" "$source"
done
for compiler in "${compilers[@]}"; do wait "$compiler"; done
"$CXX" "${flags[@]}" "${objects[@]}" -o "$build/$program" -lpthread
if [ "$target" = races ]; then
    status=0
    "${runner[@]}" "$build/$program" 60 planted 2>"$build/planted.log" || status=$?
    [ $status = 66 ] || { echo "the planted race was not found, but status $status" >&2; exit 1; }
fi
"${runner[@]}" "$build/$program" "${@:2}"
