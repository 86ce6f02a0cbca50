// Stage 1: vertices to TriangleRecords, visibility, statistics and the number of tiles each triangle touches.
#include <algorithm>
#include <bit>
#include <cmath>
#include <limits>

#include "math/kernels.h"
#include "raster.h"
#include "raster_tiles.h"

namespace etsplat {
namespace {

constexpr int64_t kChunk = 1024;
constexpr float kSupportMargin = 1.0f + 1e-4f;  // the alpha test decides; the extent only bounds the work
constexpr float kLargestExtent = 1e6f;

bool all_finite(const float* values, int64_t n) {
    float sum = 0.0f;  // Inf and NaN survive a sum of (value - value)
    for (int64_t i = 0; i < n; ++i) sum += values[i] - values[i];
    return sum == 0.0f;
}

float kernel_support(int kernel, float ratio, float sigma) {
    switch (kernel) {
        case 0: return SingleSided::support(ratio, sigma);
        case 1: return Bilateral::support(ratio, sigma);
        case 2: return Elastic::support(ratio, sigma);
        default: return Hard::support(ratio, sigma);
    }
}

KernelCoefficients kernel_coefficients(int kernel, float sigma) {
    switch (kernel) {
        case 0: return SingleSided::coefficients(sigma);
        case 1: return Bilateral::coefficients(sigma);
        case 2: return Elastic::coefficients(sigma);
        default: return Hard::coefficients(sigma);
    }
}

// Largest visible x, or a negative number if nothing is visible.
float visible_extent(const RasterCall& call, float opacity, float sigma) {
    float extent = call.x_max;
    if (call.alpha_min > 0.0f) {
        const float ratio = opacity / call.alpha_min;
        if (!(ratio >= 1.0f)) return -1.0f;
        const float support = kernel_support(call.kernel, std::max(ratio, 1.0f + 1e-6f), std::max(sigma, kMinSigma));
        extent = std::min(extent, support * kSupportMargin + 1e-5f);
    } else if (call.kernel == 0 || call.kernel == 3) {
        extent = std::min(extent, 1.0f);
    }
    return std::min(extent, kLargestExtent);
}

struct Inputs {
    const RasterCall& call;
    const float* flat;
    const float* corner;
    const float* opacities;
    const float* sigmas;

    explicit Inputs(const RasterCall& c)
        : call(c),
          flat(reinterpret_cast<const float*>(c.flat_colors)),
          corner(reinterpret_cast<const float*>(c.corner_colors)),
          opacities(reinterpret_cast<const float*>(c.opacities)),
          sigmas(reinterpret_cast<const float*>(c.sigmas)) {}

    bool finite(int64_t i) const {
        return all_finite(flat + i * call.flat_channels, call.flat_channels) &&
               all_finite(corner + i * 3 * call.corner_channels, 3 * call.corner_channels);
    }
};

void write_record(TriangleRecord& record, const Triangle2D& t, float extent) {
    record.qx = record.qy = 0.0f;
    // relative to the first vertex, where differences are exact
    for (int k = 1; k < 3; ++k) {
        record.qx += (t.x[k] - t.x[0]) / t.weight[k];
        record.qy += (t.y[k] - t.y[0]) / t.weight[k];
    }
    record.qx += t.x[0];
    record.qy += t.y[0];
    record.left = record.top = std::numeric_limits<float>::max();
    record.right = record.bottom = std::numeric_limits<float>::lowest();
    for (int k = 0; k < 3; ++k) {
        record.gx[k] = -t.weight[k] * t.ax[k];
        record.gy[k] = -t.weight[k] * t.ay[k];
        const float x = extent * (t.x[k] - record.qx), y = extent * (t.y[k] - record.qy);
        record.left = std::min(record.left, x);
        record.right = std::max(record.right, x);
        record.top = std::min(record.top, y);
        record.bottom = std::max(record.bottom, y);
    }
    record.extent = extent;
}

void write_attributes(AttributeRecord& record, const Triangle2D& t, const float* view, float qx, float qy) {
    const float cx = t.x[0] + ((t.x[1] - t.x[0]) + (t.x[2] - t.x[0])) / 3.0f;
    const float cy = t.y[0] + ((t.y[1] - t.y[0]) + (t.y[2] - t.y[0])) / 3.0f;
    for (int k = 0; k < 3; ++k) {
        record.ax[k] = t.ax[k];
        record.ay[k] = t.ay[k];
        record.inverse_z[k] = 1.0f / view[3 * k + 2];
    }
    record.offset_x = qx - cx;
    record.offset_y = qy - cy;
    record.centroid_z = (view[2] + view[5] + view[8]) / 3.0f;
}

float screen_size(const Triangle2D& t) {
    const float cx = (t.x[0] + t.x[1] + t.x[2]) / 3.0f, cy = (t.y[0] + t.y[1] + t.y[2]) / 3.0f;
    float largest = 0.0f;
    for (int k = 0; k < 3; ++k) largest = std::max(largest, std::hypot(t.x[k] - cx, t.y[k] - cy));
    return largest;
}

bool meets_image(const TriangleRecord& r, int width, int height) {
    return r.qx + r.right >= 0.0f && r.qx + r.left <= static_cast<float>(width) && r.qy + r.bottom >= 0.0f &&
           r.qy + r.top <= static_cast<float>(height);
}

// Returns the depth of a visible triangle and writes its record; a negative number for an invisible one.
float project_one(RasterState& state, const Inputs& in, int64_t i, Triangle2D& t) {
    const RasterCall& call = state.call;
    const float opacity = in.opacities[i], sigma = in.sigmas[call.shared_sigma ? 0 : i];
    if (!(opacity > 0.0f) || !(sigma > 0.0f) || !std::isfinite(opacity) || !std::isfinite(sigma)) return -1.0f;
    const float extent = visible_extent(call, opacity, sigma);
    if (!(extent > 0.0f) || !in.finite(i)) return -1.0f;
    float view[9];
    if (!load_triangle(state, i, view, t)) return -1.0f;
    TriangleRecord& record = state.records[i];
    write_record(record, t, extent);
    if (!meets_image(record, call.width, call.height)) return -1.0f;
    record.opacity = opacity;
    const KernelCoefficients coefficients = kernel_coefficients(call.kernel, std::max(sigma, kMinSigma));
    record.exponent = coefficients.exponent;
    record.scale = coefficients.scale;
    if (state.attributes.size() > 0) write_attributes(state.attributes[i], t, view, record.qx, record.qy);
    return (view[2] + view[5] + view[8]) / 3.0f;
}

}  // namespace

bool load_triangle(const RasterState& state, int64_t i, float* view, Triangle2D& t) {
    const RasterCall& call = state.call;
    const auto* vertices = reinterpret_cast<const float*>(call.vertices);
    const auto* faces = reinterpret_cast<const int32_t*>(call.faces);
    for (int k = 0; k < 3; ++k) {
        const int64_t vertex = faces ? faces[3 * i + k] : 3 * i + k;
        to_camera(state.camera, vertices + 3 * vertex, view + 3 * k);
        if (!(view[3 * k + 2] > call.near_plane) || !(view[3 * k + 2] < 1e30f)) return false;
        project(state.camera, view + 3 * k, t.x[k], t.y[k]);
        if (!(std::abs(t.x[k]) < 1e15f) || !(std::abs(t.y[k]) < 1e15f)) return false;
    }
    return set_up(t, static_cast<Distance>(call.distance));
}

void project_triangles(RasterState& state) {
    const RasterCall& call = state.call;
    const int64_t n = call.num_triangles;
    state.records.resize(n);
    state.keys.resize(n);
    state.tile_count.resize(n);
    const Inputs inputs(call);
    auto* sizes = reinterpret_cast<float*>(call.screen_size);
    auto* inradii = reinterpret_cast<float*>(call.inradius);
    auto* visible = reinterpret_cast<bool*>(call.visible);
    parallel_for(n, kChunk, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) {
            Triangle2D t;
            const float depth = project_one(state, inputs, i, t);
            const bool seen = depth > 0.0f;
            int32_t tiles = 0;
            if (seen) for_each_tile(state.records[i], state.pass, [&](int) { ++tiles; });
            state.tile_count[i] = tiles;
            state.keys[i] = seen ? std::bit_cast<uint32_t>(depth) : 0u;
            if (visible) {
                visible[i] = seen;
                sizes[i] = seen ? screen_size(t) : 0.0f;
                inradii[i] = seen ? inradius(t) : 0.0f;
            }
        }
    });
}

}  // namespace etsplat
