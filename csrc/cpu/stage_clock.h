// Where the time of a render goes: wall seconds of the calling thread for each stage, and the part of them inside
// parallel_for. A lap reads the clock once, so it is always on.
#pragma once

#include <chrono>

#include "parallel.h"

namespace etsplat {

enum class Stage { kProject, kBin, kForward, kBackward, kReduce };
constexpr int kStages = 5;
constexpr const char* kStageNames[kStages] = {"project", "bin", "forward", "backward", "reduce"};

struct StageSeconds {
    double wall = 0.0, parallel = 0.0;
};

class StageClock {
public:
    explicit StageClock(StageSeconds* stages) : stages_(stages) {}
    // Books the time since the last lap, or since construction, to a stage.
    void lap(Stage stage) {
        const auto now = std::chrono::steady_clock::now();
        const double parallel = parallel_seconds();
        stages_[static_cast<int>(stage)] = {std::chrono::duration<double>(now - last_).count(), parallel - parallel_};
        last_ = now;
        parallel_ = parallel;
    }

private:
    StageSeconds* stages_;
    std::chrono::steady_clock::time_point last_ = std::chrono::steady_clock::now();
    double parallel_ = parallel_seconds();
};

}  // namespace etsplat
