#!/usr/bin/env bash
# Everything that wants a GPU, on a machine with Python 3.12, a CUDA build of torch >= 2.11, nanobind, scikit-build-core and
# ninja, and no network: builds, runs the tests marked cuda, the benchmarks, compute-sanitizer, one full-size
# reconstruction and one soup; prints a short table last. A step that fails does not stop the others.
#
#   benchmarks/gpu_run.sh              all steps, in the order of what they tell
#   benchmarks/gpu_run.sh test bench   some of: build doctor first sphere test bench profile sanitize reconstruct train
#
# For a device of which there are ten minutes: `build doctor first sphere`, some three of them the build unless WHEELS has
# the package; then `test bench`.
#   doctor     what is seen: driver, torch, NVRTC. If this fails, nothing else can work.
#   first      tests of launches, sorting and the rasterizer, which say which kernel is wrong where one is
#   sphere     one scene: compare "measured" with the floors beside it (docs/gpu_kernels.md has those of other devices), and
#              the graph's time with the sum of the kernels': more than some 3 us a launch apart is the host
# Send back $OUT/report.tar.gz, whatever failed: logs, results, and what the device is.
#
#   PYTHON=python3.12    the interpreter that has torch
#   WHEELS=folder        wheels of packages that it lacks (nanobind-backend, tyro, trimesh, hypothesis, ...); with one of
#                        etsplat itself nothing is built
#   JOBS=8               tests side by side, where there is pytest-xdist
#   OUT=build/gpu        logs; results go to benchmarks/results
set -uo pipefail
cd "$(dirname "$0")/.."

PYTHON=${PYTHON:-python3}
OUT=${OUT:-build/gpu}
SITE=$PWD/build/gpu/site
mkdir -p "$OUT" "$SITE"
export PYTHONPATH=$SITE PYTHONUNBUFFERED=1 ETSPLAT_CACHE_DIR=$PWD/build/gpu/kernels
steps=("$@")
[ $# -gt 0 ] || steps=(build doctor test bench profile sanitize reconstruct train)
summary=()
"$PYTHON" -c 'import sys, torch; sys.exit(not torch.cuda.is_available())' || { echo "no GPU that torch can use" >&2; exit 1; }

step() { # name, seconds, command...
    local name=$1 limit=$2 begin=$SECONDS status
    shift 2
    echo "== $name"
    timeout "$limit" "$@" > >(tee "$OUT/$name.log") 2>&1
    status=$?
    summary+=("$(printf '%-28s %-9s %4d s' "$name" "$([ $status -eq 0 ] && echo ok || echo "exit $status")" $((SECONDS - begin)))")
    return $status
}

pip_target=("$PYTHON" -m pip --disable-pip-version-check install --quiet --no-index --no-deps --upgrade --target "$SITE")
pytest_cuda=("$PYTHON" -m pytest -p no:cacheprovider --gpu)
! "$PYTHON" -c 'import xdist' 2>/dev/null || pytest_cuda+=(--numprocesses "${JOBS:-8}")

build() {
    [ -z "${WHEELS:-}" ] || step wheels 120 "${pip_target[@]}" "$WHEELS"/*.whl || return
    ! compgen -G "${WHEELS:-/nowhere}/etsplat-*.whl" >/dev/null || return 0
    step build 420 "${pip_target[@]}" --no-build-isolation .
}

first() { step first 240 "${pytest_cuda[@]}" tests/engines tests/ops/test_rasterize_engines.py; }
run_tests() { step tests 540 "${pytest_cuda[@]}" tests; }

# Small scenes: memcheck makes a kernel some fifty times slower, racecheck more.
sanitize() {
    local tool
    if ! command -v compute-sanitizer >/dev/null; then
        summary+=("compute-sanitizer is not installed")
        return
    fi
    for tool in memcheck racecheck; do
        step "$tool" 540 compute-sanitizer --tool "$tool" --error-exitcode 1 "${pytest_cuda[@]}" \
            -m sanitize tests/engines tests/ops
    done
}

bench() { step bench 540 "$PYTHON" -m benchmarks.gpu; }
sphere() { step sphere 180 "$PYTHON" -m benchmarks.gpu --scene sphere6; }

# Why a kernel takes what it takes, by the hardware's counters; clocks are left as they are.
profile() {
    local scene
    if ! command -v ncu >/dev/null; then
        summary+=("ncu (Nsight Compute) is not installed")
        return
    fi
    for scene in sphere6 soup4m; do
        step "profile_$scene" 180 ncu --clock-control none --kernel-name 'regex:^(raster|radix|soup)_' --launch-skip 30 \
            --launch-count 16 --section SpeedOfLight --section Occupancy --section WarpStateStats --section SchedulerStats \
            --section MemoryWorkloadAnalysis --section InstructionStats "$PYTHON" -c "
from benchmarks import gpu_scenes, gpu_timing
scene = gpu_scenes.load('$scene', 'cuda')
for _ in range(4):
    gpu_timing.step(scene)
"
    done
}

etsplat=("$PYTHON" -c 'import sys; from etsplat.cli import main; sys.exit(main())')
doctor() { step doctor 120 "${etsplat[@]}" doctor; }
# A captured graph for each size of photos, densification, opaque evaluation: 3,000 steps.
train() { step train 540 "${etsplat[@]}" demo scene --device cuda --out "$OUT/train" --overwrite; }
reconstruct() { step reconstruct 540 "${etsplat[@]}" demo --device cuda --out "$OUT/reconstruct" --overwrite; }

for name in "${steps[@]}"; do
    case $name in
        build) build ;;
        doctor) doctor ;;
        first) first ;;
        sphere) sphere ;;
        test) run_tests ;;
        profile) profile ;;
        sanitize) sanitize ;;
        bench) bench ;;
        reconstruct) reconstruct ;;
        train) train ;;
        *) echo "no step $name: choose from build doctor first sphere test bench profile sanitize reconstruct train" >&2; exit 2 ;;
    esac
done

echo
echo "== summary, $(date -u +%Y-%m-%d), $(nvidia-smi --query-gpu=name,driver_version --format=csv,noheader 2>/dev/null || echo 'no GPU')"
printf '%s\n' "${summary[@]}"
grep -hE "forward|backward|a whole" "$OUT/bench.log" 2>/dev/null | grep -E "sphere|soup|whole" | tail -14
grep -hE "passed|failed" "$OUT"/tests.log 2>/dev/null | tail -1
nvidia-smi -q > "$OUT/device.txt" 2>&1
tar --create --gzip --file "$OUT/report.tar.gz" "$OUT"/*.log "$OUT/device.txt" $(ls benchmarks/results/gpu_*.json 2>/dev/null) &&
    echo "to send back: $OUT/report.tar.gz"
