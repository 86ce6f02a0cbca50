// What is remembered of a triangle of a soup while it is on trial (etsplat/optim/densification.py).
#pragma once

#include "portable.h"

namespace etsplat {

constexpr float kVisibleInradius = 1.0f;  // pixels

struct SoupRecord {
    float importance, screen_size;
    int seen, trial;
};

// After another view. A trial lasts `views` views and begins with an epoch.
ETSPLAT_FN SoupRecord after_view(SoupRecord record, float max_weight, float screen_size, float inradius, int views,
                                 bool epoch_starts) {
    record.importance = vmax(record.importance, max_weight);
    record.screen_size = vmax(record.screen_size, screen_size);
    if (record.trial < views && (epoch_starts || record.trial > 0)) {
        record.seen += inradius > kVisibleInradius ? 1 : 0;
        record.trial += 1;
    }
    return record;
}

}  // namespace etsplat
