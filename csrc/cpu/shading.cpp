// How it is scheduled. Forward: pixels are shaded in parallel. Backward: a fixed number of bands of rows gather the
// cotangents of colours and of interpolation, each for itself and only for what it shows, run by run of equal triangles; on
// one thread the bands are added up in their order. Nothing depends on which thread runs what.
#include "shading.h"

#include <algorithm>
#include <optional>
#include <vector>

#include "math/texture.h"
#include "parallel.h"
#include "scratch.h"

namespace etsplat {
namespace {

constexpr int kBands = 8;  // in the backward pass

// The camera's centre in world space.
struct Center {
    double at[3] = {0.0, 0.0, 0.0};

    explicit Center(const OpaqueCamera& camera) {
        const float* m = camera.viewmat;
        for (int j = 0; j < 3; ++j) {
            for (int i = 0; i < 3; ++i) at[j] -= static_cast<double>(m[4 * i + j]) * m[4 * i + 3];
        }
    }

    ViewInverse<double> inverse(const OpaqueMesh& mesh, int64_t face) const {
        Vector3<double> corner[3];
        for (int i = 0; i < 3; ++i) {
            const float* v = mesh.vertices + 3 * static_cast<int64_t>(mesh.faces[3 * face + i]);
            corner[i] = {v[0] - at[0], v[1] - at[1], v[2] - at[2]};
        }
        return view_inverse(corner);
    }
};

// Calls visit(face, begin, end) for every run of pixels of a row that see the same triangle, or none.
template <class Visit>
void for_each_run(const int32_t* triangle, int32_t width, int64_t y, const Visit& visit) {
    const int64_t row = y * width;
    for (int32_t x = 0; x < width;) {
        const int32_t face = triangle[row + x];
        int32_t end = x + 1;
        while (end < width && triangle[row + end] == face) ++end;
        visit(face, row + x, row + end);
        x = end;
    }
}

// Sums of some of many rows: those that are asked for, 0 at first. A large mesh shows few of its faces in a band.
class SparseRows {
public:
    SparseRows(int64_t rows, int32_t width) : width_(width), place_(rows) { std::fill(place_.begin(), place_.end(), -1); }

    // Where the sums of a row begin.
    int64_t place(int64_t row) {
        int32_t& found = place_[row];
        if (found < 0) {
            found = static_cast<int32_t>(rows_.size());
            rows_.push_back(row);
            sums_.resize(sums_.size() + width_, 0.0f);
        }
        return static_cast<int64_t>(found) * width_;
    }
    float& operator[](int64_t place) { return sums_[place]; }

    void add_to(float* out) const {
        const float* from = sums_.data();
        for (const int64_t row : rows_) {
            for (int32_t i = 0; i < width_; ++i) out[row * width_ + i] += *from++;
        }
    }

private:
    int32_t width_;
    Scratch<int32_t> place_;
    std::vector<int64_t> rows_;
    std::vector<float> sums_;
};

// Cotangents of one band of rows.
struct BandSums {
    SparseRows colors, vertices;
    std::vector<double> background;
};

class ShadeBackward {
public:
    ShadeBackward(const ShadeInput& in, const float* grad_shaded, const ShadeGradients& out)
        : in_(in), grad_shaded_(grad_shaded), out_(out), center_(in.camera), channels_(in.channels) {
        const int64_t faces = in.mesh.num_faces, vertices = in.mesh.num_vertices;
        interpolates_ = in.colors_of == ColorsOf::kVertices || in.colors_of == ColorsOf::kCorners;
        moves_ = out.vertices && interpolates_;
        colored_rows_ = 0;
        if (!out.colors) return;
        if (in.colors_of == ColorsOf::kFaces) colored_rows_ = faces;
        if (in.colors_of == ColorsOf::kVertices) colored_rows_ = vertices;
        if (in.colors_of == ColorsOf::kCorners) colored_rows_ = 3 * faces;
    }

    BandSums gather(int band) const {
        BandSums sums{{colored_rows_, channels_}, {moves_ ? in_.mesh.num_vertices : 0, 3}, std::vector<double>(channels_, 0.0)};
        const int32_t width = in_.camera.width, height = in_.camera.height;
        for (int32_t y = height * band / kBands; y < height * (band + 1) / kBands; ++y) {
            for_each_run(in_.triangle, width, y, [&](int32_t face, int64_t begin, int64_t end) {
                run(face, begin, end, sums);
            });
        }
        return sums;
    }

    void add_up(const std::vector<std::optional<BandSums>>& bands) const {
        for (const auto& band : bands) {
            band->colors.add_to(out_.colors);
            band->vertices.add_to(out_.vertices);
        }
        if (!out_.background) return;
        for (int32_t c = 0; c < channels_; ++c) {
            double total = 0.0;
            for (const auto& band : bands) total += band->background[c];
            out_.background[c] += static_cast<float>(total);
        }
    }

private:

    // Pixels [begin, end) of a row see the same face, or none.
    void run(int32_t face, int64_t begin, int64_t end, BandSums& sums) const {
        if (face >= 0 && interpolates_) return interpolated(face, begin, end, sums);
        if (face >= 0 && !out_.colors) return;
        const int64_t size = (end - begin) * channels_;
        const float* grad = grad_shaded_ + begin * channels_;
        if (face >= 0 && in_.colors_of == ColorsOf::kPixels) {
            for (int64_t i = 0; i < size; ++i) out_.colors[begin * channels_ + i] += grad[i];
            return;
        }
        const int64_t into = face < 0 ? 0 : sums.colors.place(face);
        for (int64_t p = begin; p < end; ++p) {
            const float* g = grad_shaded_ + p * channels_;
            for (int32_t c = 0; c < channels_; ++c) {
                if (face < 0) sums.background[c] += g[c];
                else sums.colors[into + c] += g[c];
            }
        }
    }

    void interpolated(int64_t face, int64_t begin, int64_t end, BandSums& sums) const {
        ViewInverse<double> inverse;
        if (moves_) inverse = center_.inverse(in_.mesh, face);
        Vector3<double> moved[3] = {};
        int64_t from[3], into[3] = {0, 0, 0};
        for (int i = 0; i < 3; ++i) {
            from[i] = in_.corner_color(face, i);
            if (out_.colors) into[i] = sums.colors.place(from[i] / channels_);
        }
        for (int64_t p = begin; p < end; ++p) {
            const float* g = grad_shaded_ + p * channels_;
            double b[3], cotangent[3] = {0.0, 0.0, 0.0};
            for (int i = 0; i < 3; ++i) {
                b[i] = in_.barycentrics[3 * p + i];
                for (int32_t c = 0; c < channels_; ++c) {
                    if (out_.colors) sums.colors[into[i] + c] += static_cast<float>(b[i]) * g[c];
                    cotangent[i] += static_cast<double>(g[c]) * in_.colors[from[i] + c];
                }
            }
            if (!moves_) continue;
            const Vector3<double> u = interpolation_derivative(inverse, b, cotangent);
            for (int i = 0; i < 3; ++i) moved[i] = moved[i] - b[i] * u;
        }
        for (int i = 0; moves_ && i < 3; ++i) {
            const int64_t place = sums.vertices.place(in_.mesh.faces[3 * face + i]);
            sums.vertices[place] += static_cast<float>(moved[i].x);
            sums.vertices[place + 1] += static_cast<float>(moved[i].y);
            sums.vertices[place + 2] += static_cast<float>(moved[i].z);
        }
    }

    const ShadeInput& in_;
    const float* grad_shaded_;
    const ShadeGradients& out_;
    Center center_;
    int32_t channels_;
    int64_t colored_rows_;
    bool interpolates_, moves_;
};

}  // namespace

void shade(const ShadeInput& in, float* shaded) {
    const int32_t channels = in.channels;
    const int64_t pixels = static_cast<int64_t>(in.camera.width) * in.camera.height;
    parallel_for(pixels, 8192, [&](int64_t begin, int64_t end) {
        for (int64_t p = begin; p < end; ++p) {
            float* out = shaded + p * channels;
            const int64_t face = in.triangle[p];
            if (face < 0) {
                for (int32_t c = 0; c < channels; ++c) out[c] = in.background ? in.background[c] : 0.0f;
            } else if (in.colors_of == ColorsOf::kFaces) {
                std::copy_n(in.colors + face * channels, channels, out);
            } else if (in.colors_of == ColorsOf::kPixels) {
                std::copy_n(in.colors + p * channels, channels, out);
            } else {
                const float* b = in.barycentrics + 3 * p;
                const float* color[3];
                for (int i = 0; i < 3; ++i) color[i] = in.colors + in.corner_color(face, i);
                for (int32_t c = 0; c < channels; ++c) {
                    out[c] = b[0] * color[0][c] + b[1] * color[1][c] + b[2] * color[2][c];
                }
            }
        }
    });
}

void shade_backward(const ShadeInput& input, const float* grad_shaded, const ShadeGradients& gradients) {
    const ShadeBackward shading(input, grad_shaded, gradients);
    std::vector<std::optional<BandSums>> bands(kBands);
    parallel_for(kBands, 1, [&](int64_t begin, int64_t end) {
        for (int64_t band = begin; band < end; ++band) bands[band].emplace(shading.gather(static_cast<int>(band)));
    });
    shading.add_up(bands);
}

void texture_detail(const OpaqueMesh& mesh, const OpaqueCamera& camera, const int32_t* triangle,
                    const float* barycentrics, const float* depth, const float* uvs, int width, int height, float* lod) {
    const Center center(camera);
    const RayTurn turn = ray_turn(pinhole(camera));
    parallel_for(camera.height, 8, [&](int64_t begin, int64_t end) {
        for (int64_t y = begin; y < end; ++y) {
            for_each_run(triangle, camera.width, y, [&](int64_t face, int64_t first, int64_t last) {
                if (face < 0) return std::fill(lod + first, lod + last, 0.0f);
                const ViewInverse<double> inverse = center.inverse(mesh, face);
                for (int64_t p = first; p < last; ++p) {
                    const float* b = barycentrics + 3 * p;
                    lod[p] = level_of_detail(inverse, turn, b, uvs + 6 * face, depth[p], width, height);
                }
            });
        }
    });
}

}  // namespace etsplat
