// How it is scheduled. Forward: (1) vertices are projected, and each face learns which of its edges are silhouettes, in
// parallel; (2) pixels are shaded in parallel; (3) bands of rows look for pairs of neighbouring pixels with a silhouette
// between them, in parallel, each into a list of its own (36 bytes a blend, a few per silhouette pixel); (4) the lists are
// carried out in their order, on one thread: there are as many blends as silhouette pixels, a hundredth of the image.
//
// Backward: (1) blends hand their pixels' cotangents on, and move their edge's ends, on one thread; (2) a fixed number of
// bands of rows gather the cotangents of colours and of interpolation, each into arrays of its own, run by run of equal
// triangles; (3) the bands are added up in their order. Nothing depends on which thread runs what.
#include "antialias.h"

#include <algorithm>

#include "math/antialias.h"
#include "math/triangle.h"
#include "parallel.h"

namespace etsplat {
namespace {

constexpr int kBands = 8;  // in the backward pass; each has arrays as long as the colours and vertices

void shade(const AntialiasInput& in, float* shaded) {
    const int32_t channels = in.colors.channels;
    const int64_t pixels = static_cast<int64_t>(in.camera.width) * in.camera.height;
    parallel_for(pixels, 8192, [&](int64_t begin, int64_t end) {
        for (int64_t p = begin; p < end; ++p) {
            float* out = shaded + p * channels;
            const int64_t face = in.triangle[p];
            if (face < 0) {
                std::copy(in.background, in.background + channels, out);
            } else if (in.colors.faces) {
                std::copy_n(in.colors.faces + face * channels, channels, out);
            } else {
                const float* b = in.barycentrics + 3 * p;
                const int32_t* k = in.mesh.faces + 3 * face;
                const float* color[3];
                for (int i = 0; i < 3; ++i) color[i] = in.colors.vertices + static_cast<int64_t>(k[i]) * channels;
                for (int32_t c = 0; c < channels; ++c) {
                    out[c] = b[0] * color[0][c] + b[1] * color[1][c] + b[2] * color[2][c];
                }
            }
        }
    });
}

// Cotangents of one band of rows.
struct BandSums {
    std::vector<float> colors, vertices;
    std::vector<double> background;
};

class ShadeBackward {
public:
    ShadeBackward(const AntialiasInput& in, const AntialiasGradients& out)
        : in_(in), out_(out), channels_(in.colors.channels) {
        const float* m = in.camera.viewmat;
        for (int j = 0; j < 3; ++j) {
            center_[j] = 0.0;
            for (int i = 0; i < 3; ++i) center_[j] -= static_cast<double>(m[4 * i + j]) * m[4 * i + 3];
        }
        colors_size_ = (in.colors.faces ? in.mesh.num_faces : in.mesh.num_vertices) * channels_;
        moves_ = out.vertices && !in.colors.faces;
    }

    void gather(int band, BandSums& sums) const {
        sums.colors.assign(colors_size_, 0.0f);
        sums.vertices.assign(moves_ ? 3 * in_.mesh.num_vertices : 0, 0.0f);
        sums.background.assign(channels_, 0.0);
        const int32_t width = in_.camera.width, height = in_.camera.height;
        for (int32_t y = height * band / kBands; y < height * (band + 1) / kBands; ++y) {
            const int64_t row = static_cast<int64_t>(y) * width;
            for (int32_t x = 0; x < width;) {
                const int32_t face = in_.triangle[row + x];
                int32_t end = x + 1;
                while (end < width && in_.triangle[row + end] == face) ++end;
                run(face, row + x, row + end, sums);
                x = end;
            }
        }
    }

    void add_up(const std::vector<BandSums>& bands) const {
        if (out_.colors) add(bands, &BandSums::colors, colors_size_, out_.colors);
        if (moves_) add(bands, &BandSums::vertices, 3 * in_.mesh.num_vertices, out_.vertices);
        if (!out_.background) return;
        for (int32_t c = 0; c < channels_; ++c) {
            double total = 0.0;
            for (const BandSums& band : bands) total += band.background[c];
            out_.background[c] += static_cast<float>(total);
        }
    }

private:
    static void add(const std::vector<BandSums>& bands, std::vector<float> BandSums::* sums, int64_t size, float* out) {
        parallel_for(size, 1 << 15, [&](int64_t begin, int64_t end) {
            for (const BandSums& band : bands) {
                const float* from = (band.*sums).data();
                for (int64_t i = begin; i < end; ++i) out[i] += from[i];
            }
        });
    }

    // Pixels [begin, end) of a row see the same face, or none.
    void run(int32_t face, int64_t begin, int64_t end, BandSums& sums) const {
        if (face >= 0 && !in_.colors.faces) return interpolated(face, begin, end, sums);
        float* into = sums.colors.data() + static_cast<int64_t>(std::max(face, 0)) * channels_;
        for (int64_t p = begin; p < end; ++p) {
            const float* g = out_.grad_shaded + p * channels_;
            for (int32_t c = 0; c < channels_; ++c) {
                if (face < 0) sums.background[c] += g[c];
                else into[c] += g[c];
            }
        }
    }

    void interpolated(int64_t face, int64_t begin, int64_t end, BandSums& sums) const {
        const int32_t* k = in_.mesh.faces + 3 * face;
        ViewInverse<double> inverse;
        if (moves_) {
            Vector3<double> corner[3];
            for (int i = 0; i < 3; ++i) {
                const float* v = in_.mesh.vertices + 3 * static_cast<int64_t>(k[i]);
                corner[i] = {v[0] - center_[0], v[1] - center_[1], v[2] - center_[2]};
            }
            inverse = view_inverse(corner);
        }
        Vector3<double> moved[3] = {};
        for (int64_t p = begin; p < end; ++p) {
            const float* g = out_.grad_shaded + p * channels_;
            double b[3], cotangent[3] = {0.0, 0.0, 0.0};
            for (int i = 0; i < 3; ++i) {
                b[i] = in_.barycentrics[3 * p + i];
                const int64_t place = static_cast<int64_t>(k[i]) * channels_;
                for (int32_t c = 0; c < channels_; ++c) {
                    sums.colors[place + c] += static_cast<float>(b[i]) * g[c];
                    cotangent[i] += static_cast<double>(g[c]) * in_.colors.vertices[place + c];
                }
            }
            if (!moves_) continue;
            const Vector3<double> u = interpolation_derivative(inverse, b, cotangent);
            for (int i = 0; i < 3; ++i) moved[i] = moved[i] - b[i] * u;
        }
        for (int i = 0; moves_ && i < 3; ++i) {
            float* into = sums.vertices.data() + 3 * static_cast<int64_t>(k[i]);
            into[0] += static_cast<float>(moved[i].x);
            into[1] += static_cast<float>(moved[i].y);
            into[2] += static_cast<float>(moved[i].z);
        }
    }

    const AntialiasInput& in_;
    const AntialiasGradients& out_;
    int32_t channels_;
    double center_[3] = {0.0, 0.0, 0.0};
    int64_t colors_size_;
    bool moves_;
};

// Cotangents of the shaded pixels, and what the silhouettes' ends get from the weights.
void blend_backward(const AntialiasState& state, const AntialiasInput& in, const AntialiasGradients& out) {
    const int32_t channels = in.colors.channels;
    const int64_t size = static_cast<int64_t>(in.camera.width) * in.camera.height * channels;
    parallel_for(size, 1 << 16, [&](int64_t begin, int64_t end) {
        std::copy(out.color + begin, out.color + end, out.grad_shaded + begin);
    });
    const PinholeCamera camera = pinhole(in.camera);
    for (const Blend& blend : state.blends) {
        const int64_t to = static_cast<int64_t>(blend.to) * channels, from = static_cast<int64_t>(blend.from) * channels;
        double by_weight = 0.0;
        for (int32_t c = 0; c < channels; ++c) {
            const float g = out.color[to + c];
            by_weight += static_cast<double>(g) * (out.shaded[from + c] - out.shaded[to + c]);
            out.grad_shaded[from + c] += blend.weight * g;
            out.grad_shaded[to + c] -= blend.weight * g;
        }
        if (!out.vertices) continue;
        for (int end = 0; end < 2; ++end) {
            const float* p = in.mesh.vertices + 3 * static_cast<int64_t>(blend.vertex[end]);
            const double world[3] = {p[0], p[1], p[2]};
            double view[3], grad_view[3] = {0.0, 0.0, 0.0}, grad_world[3], x, y;
            to_camera(camera, world, view);
            project(camera, view, x, y);
            project_backward(camera, view, x, y, by_weight * blend.derivative[end][0],
                             by_weight * blend.derivative[end][1], grad_view);
            to_world_gradient(camera, grad_view, grad_world);
            float* into = out.vertices + 3 * static_cast<int64_t>(blend.vertex[end]);
            for (int i = 0; i < 3; ++i) into[i] += static_cast<float>(grad_world[i]);
        }
    }
}

}  // namespace

std::shared_ptr<AntialiasState> antialias_forward(const AntialiasInput& input, float* shaded, float* color) {
    auto state = std::make_shared<AntialiasState>();
    shade(input, shaded);
    state->blends = find_blends(input);
    const int32_t channels = input.colors.channels;
    const int64_t size = static_cast<int64_t>(input.camera.width) * input.camera.height * channels;
    parallel_for(size, 1 << 16, [&](int64_t begin, int64_t end) { std::copy(shaded + begin, shaded + end, color + begin); });
    for (const Blend& blend : state->blends) {
        const int64_t to = static_cast<int64_t>(blend.to) * channels, from = static_cast<int64_t>(blend.from) * channels;
        for (int32_t c = 0; c < channels; ++c) color[to + c] += blend.weight * (shaded[from + c] - shaded[to + c]);
    }
    return state;
}

void antialias_backward(const AntialiasState& state, const AntialiasInput& input, const AntialiasGradients& gradients) {
    blend_backward(state, input, gradients);
    const ShadeBackward shading(input, gradients);
    std::vector<BandSums> bands(kBands);
    parallel_for(kBands, 1, [&](int64_t begin, int64_t end) {
        for (int64_t band = begin; band < end; ++band) shading.gather(static_cast<int>(band), bands[band]);
    });
    shading.add_up(bands);
}

}  // namespace etsplat
