#include "photo_agreement.h"

#include <algorithm>
#include <cmath>
#include <functional>
#include <limits>
#include <vector>

#include "math/vector3.h"
#include "parallel.h"

namespace etsplat {
namespace {

using Vec = Vector3<float>;

constexpr int32_t kLanes = 16;  // floats that are summed side by side; patches are padded to it

Vec vec(const float* values) { return {values[0], values[1], values[2]}; }

Vec normalized(Vec a) { return (1.0f / std::max(std::sqrt(dot(a, a)), 1e-12f)) * a; }

float dot_of_patches(const float* a, const float* b, int32_t size) {
    float lanes[kLanes] = {};
    for (int32_t i = 0; i < size; i += kLanes) {
        for (int32_t k = 0; k < kLanes; ++k) lanes[k] += a[i + k] * b[i + k];
    }
    for (int32_t half = kLanes / 2; half > 0; half /= 2) {
        for (int32_t k = 0; k < half; ++k) lanes[k] += lanes[k + half];
    }
    return lanes[0];
}

// A point before the division by its depth, which is the third; of a direction with `where` 0.
Vec projected(const AskedPhoto& photo, Vec point, float where) {
    const float *m = photo.viewmat, *K = photo.K;
    const Vec camera = {dot(vec(m), point) + where * m[3], dot(vec(m + 4), point) + where * m[7],
                        dot(vec(m + 8), point) + where * m[11]};
    return {dot(vec(K), camera), dot(vec(K + 3), camera), camera.z};
}

// Without calls, which std::floor and std::nearbyint are where processors before SSE 4.1 are to run this. For |x| < 2^22.
int32_t lower(float x) {
    const auto towards_zero = static_cast<int32_t>(x);
    return towards_zero - (static_cast<float>(towards_zero) > x);
}
int32_t nearest(float x) { return static_cast<int32_t>((x + 12582912.0f) - 12582912.0f); }  // 1.5 x 2^23

// Whether the pixel nearest to a place counts; 0 beyond the picture.
float counts(const AskedPhoto& photo, float x, float y) {
    const int32_t column = nearest(x), row = nearest(y);
    if (column < 0 || column >= photo.width || row < 0 || row >= photo.height) return 0.0f;
    return photo.mask[static_cast<int64_t>(row) * photo.width + column];
}

// The colour at a place less than a pixel beyond the picture at most, where there is black.
void look_up(const AskedPhoto& photo, float x, float y, float out[3]) {
    const int32_t width = photo.width, height = photo.height, left = lower(x), top = lower(y);
    const float right = x - static_cast<float>(left), below = y - static_cast<float>(top);
    const float weights[4] = {(1.0f - right) * (1.0f - below), right * (1.0f - below), (1.0f - right) * below,
                              right * below};
    const int64_t plane = static_cast<int64_t>(width) * height;
    if (left >= 0 && left + 1 < width && top >= 0 && top + 1 < height) {
        const float* pixel = photo.pixels + static_cast<int64_t>(top) * width + left;
        for (int32_t c = 0; c < 3; ++c, pixel += plane) {
            out[c] = weights[0] * pixel[0] + weights[1] * pixel[1] + weights[2] * pixel[width] +
                     weights[3] * pixel[width + 1];
        }
        return;
    }
    out[0] = out[1] = out[2] = 0.0f;
    for (int32_t k = 0; k < 4; ++k) {
        const int32_t column = left + k % 2, row = top + k / 2;
        if (column < 0 || column >= width || row < 0 || row >= height) continue;
        const float* pixel = photo.pixels + static_cast<int64_t>(row) * width + column;
        for (int32_t c = 0; c < 3; ++c) out[c] += weights[k] * pixel[c * plane];
    }
}

class Agreement {
public:
    Agreement(const std::vector<AskedPhoto>& photos, const AgreementRules& rules)
        : photos_(photos),
          rules_(rules),
          count_(rules.patch * rules.patch),
          size_((4 * count_ + kLanes - 1) / kLanes * kLanes),
          patches_(static_cast<size_t>(rules.asked) * size_),
          along_(static_cast<size_t>(size_) / 4),
          down_(along_.size()),
          x_(along_.size()),
          y_(along_.size()),
          mask_(along_.size()) {
        const float first = -0.5f * static_cast<float>(rules.patch - 1);
        for (int32_t i = 0; i < count_; ++i) {
            along_[i] = rules.pixel * (first + static_cast<float>(i % rules.patch));
            down_[i] = rules.pixel * (first + static_cast<float>(i / rules.patch));
        }
    }

    float at(Vec point, Vec normal, const bool* seen, int64_t stride) {
        choose(point, normal, seen, stride);
        int32_t shown = 0;
        for (const Choice& choice : choices_) {
            shown += look(photos_[choice.photo], point, normal, patches_.data() + shown * size_);
        }
        if (shown < rules_.fewest) return std::numeric_limits<float>::quiet_NaN();
        correlations_.clear();
        for (int32_t i = 0; i < shown; ++i) {
            for (int32_t j = i + 1; j < shown; ++j) {
                correlations_.push_back(dot_of_patches(patch(i), patch(j), size_));
            }
        }
        const size_t half = (correlations_.size() + 1) / 2;
        std::sort(correlations_.begin(), correlations_.end(), std::greater<float>());
        float sum = 0.0f;
        for (size_t k = 0; k < half; ++k) sum += correlations_[k];
        return sum / static_cast<float>(half);
    }

private:
    struct Choice {
        float cosine;
        size_t photo;
    };

    const float* patch(int32_t number) const { return patches_.data() + number * size_; }

    // The photos that see a point most squarely; of equal ones the first.
    void choose(Vec point, Vec normal, const bool* seen, int64_t stride) {
        choices_.clear();
        for (size_t photo = 0; photo < photos_.size(); ++photo) {
            if (!seen[photo * stride]) continue;
            const float cosine = dot(normalized(vec(photos_[photo].center) - point), normal);
            if (cosine > rules_.slant) choices_.push_back({cosine, photo});
        }
        std::stable_sort(choices_.begin(), choices_.end(),
                         [](const Choice& a, const Choice& b) { return a.cosine > b.cosine; });
        if (static_cast<int32_t>(choices_.size()) > rules_.asked) choices_.resize(rules_.asked);
    }

    // What a photo shows around a point, its mean taken away and of length 1; whether that can be compared.
    bool look(const AskedPhoto& photo, Vec point, Vec normal, float* out) {
        place(photo, point, normal);
        float counted = 0.0f;
        for (int32_t i = 0; i < count_; ++i) counted += mask_[i] = counts(photo, x_[i], y_[i]);
        if (!(counted > rules_.whole * static_cast<float>(count_))) return false;
        float mean[3] = {};
        for (int32_t i = 0; i < count_; ++i) {
            if (mask_[i] == 0.0f) continue;
            float* pixel = out + 4 * i;
            look_up(photo, x_[i], y_[i], pixel);
            for (int32_t c = 0; c < 3; ++c) mean[c] += mask_[i] * pixel[c];
        }
        for (float& sum : mean) sum /= std::max(counted, 1.0f);
        for (int32_t i = 0; i < count_; ++i) {
            float* pixel = out + 4 * i;
            for (int32_t c = 0; c < 3; ++c) pixel[c] = mask_[i] == 0.0f ? 0.0f : mask_[i] * (pixel[c] - mean[c]);
            pixel[3] = 0.0f;
        }
        std::fill(out + 4 * count_, out + size_, 0.0f);
        const float length = std::sqrt(dot_of_patches(out, out, size_));
        if (!(length > rules_.flat * std::sqrt(3.0f * static_cast<float>(count_)))) return false;
        for (int32_t i = 0; i < size_; ++i) out[i] /= std::max(length, 1e-6f);
        return true;
    }

    // Where a photo shows the pixels of the patch around a point; what it does not show is put beside its corner.
    void place(const AskedPhoto& photo, Vec point, Vec normal) {
        const Vec across = std::abs(normal.x) < 0.7f ? Vec{1.0f, 0.0f, 0.0f} : Vec{0.0f, 1.0f, 0.0f};
        const Vec u = normalized(cross(normal, across)), v = cross(normal, u);
        const Vec middle = projected(photo, point, 1.0f);
        const Vec du = projected(photo, u, 0.0f), dv = projected(photo, v, 0.0f);
        const auto width = static_cast<float>(photo.width), height = static_cast<float>(photo.height);
        const float *along = along_.data(), *down = down_.data();
        float *xs = x_.data(), *ys = y_.data();
        for (size_t i = 0; i < x_.size(); ++i) {
            const float z = middle.z + down[i] * dv.z + along[i] * du.z;
            const float x = (middle.x + down[i] * dv.x + along[i] * du.x) / z - 0.5f;
            const float y = (middle.y + down[i] * dv.y + along[i] * du.y) / z - 0.5f;
            const bool shown = (z > 0.0f) & (x > -1.0f) & (x < width) & (y > -1.0f) & (y < height);
            xs[i] = shown ? x : -2.0f;
            ys[i] = shown ? y : -2.0f;
        }
    }

    const std::vector<AskedPhoto>& photos_;
    const AgreementRules& rules_;
    int32_t count_, size_;  // pixels and floats of a patch
    std::vector<float> patches_;
    // Of each pixel of a patch: how far from its middle, where a photo shows it, and whether it counts there.
    std::vector<float> along_, down_, x_, y_, mask_;
    std::vector<Choice> choices_;
    std::vector<float> correlations_;
};

}  // namespace

void photo_agreement(const std::vector<AskedPhoto>& photos, const AgreementRules& rules, const float* points,
                     const float* normals, const bool* seen, int64_t N, float* result) {
    parallel_for(N, 64, [&](int64_t begin, int64_t end) {
        Agreement agreement(photos, rules);
        for (int64_t n = begin; n < end; ++n) {
            result[n] = agreement.at(vec(points + 3 * n), vec(normals + 3 * n), seen + n, N);
        }
    });
}

void add_differences(const float* pixels, int64_t size, float opaque, const int64_t* seen,
                     const std::vector<const int64_t*>& shown, const float* colors, float* sums) {
    const auto columns = static_cast<int64_t>(shown.size()) + 1;
    for (int64_t i = 0; i < size; ++i) {
        if (seen[i] < 0 || !(pixels[3 * size + i] > opaque)) continue;
        float* sum = sums + seen[i] * columns;
        sum[0] += 1.0f;
        for (int64_t k = 1; k < columns; ++k) {
            const float* color = colors + 3 * shown[k - 1][i];
            float error = 0.0f;
            for (int64_t c = 0; c < 3; ++c) error += std::abs(pixels[c * size + i] - color[c]);
            sum[k] += error / 3.0f;
        }
    }
}

}  // namespace etsplat
