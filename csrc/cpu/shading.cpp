// How it is scheduled. Forward: pixels are shaded in parallel. Backward: a fixed number of bands of rows gather the
// cotangents of colours and of interpolation, each for itself and only for what it shows, run by run of equal triangles; on
// one thread the bands are added up in their order. Nothing depends on which thread runs what.
#include "shading.h"

#include <algorithm>
#include <type_traits>
#include <vector>

#include "math/texture.h"
#include "parallel.h"
#include "prefetch.h"

namespace etsplat {
namespace {

constexpr int kBands = 8;      // in the backward pass
constexpr size_t kAhead = 16;  // faces of a band

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

// Cotangents of what one band of rows shows: of each of its faces, in the order in which they come.
struct BandSums {
    std::vector<int32_t> faces;
    std::vector<float> sums;  // of each: of its colour (channels), or those of `Weights` (channels, Weights::kCount)
    std::vector<float> moved; // (3, 3) of its corners' places
    std::vector<double> background;
};

// Where a thread finds the sums of a face: -1 throughout between bands, so that no band has to fill them.
class Places {
public:
    // The table of this thread, for as long as it gathers a band.
    Places(int64_t faces, BandSums& sums) : table_(of_this_thread(faces)), sums_(sums) {}
    ~Places() {
        for (const int32_t face : sums_.faces) table_[face] = -1;
    }
    Places(const Places&) = delete;
    Places& operator=(const Places&) = delete;

    // Where the sums of a face begin, so many of them, 0 at first.
    float* find(int64_t face, int32_t count) {
        int32_t& found = table_[face];
        if (found < 0) {
            found = static_cast<int32_t>(sums_.faces.size());
            sums_.faces.push_back(static_cast<int32_t>(face));
            sums_.sums.resize(sums_.sums.size() + count, 0.0f);
        }
        return sums_.sums.data() + static_cast<int64_t>(found) * count;
    }

private:
    static std::vector<int32_t>& of_this_thread(int64_t faces) {
        thread_local std::vector<int32_t> table;
        if (static_cast<int64_t>(table.size()) < faces) table.resize(faces, -1);
        return table;
    }

    std::vector<int32_t>& table_;
    BandSums& sums_;
};

// What the cotangents of a face's pixels are multiplied by before they are added up: its barycentrics and their products.
//
// With cotangents G_c of a pixel's channels, a corner gets b_k G_c, and its place -b_m u, u = V^-T (g - sum_j b_j g_j) with
// g_k = sum_c G_c C_kc (`interpolation_derivative`). Of all pixels together that is -V^-T S_m with
//
//     S_mk = sum_c (D_kc sum b_m G_c - sum_j D_jc sum b_m b_j G_c),   D_k = C_k - C_0,
//
// as barycentrics add up to 1: nothing of a face but its pixels' barycentrics has to be looked at pixel by pixel.
struct Weights {
    static constexpr int kCount = 8;  // two of them 0, to be added side by side

    float of[kCount];

    explicit Weights(const float* b)
        : of{b[0], b[1], b[2], b[0] * b[1], b[0] * b[2], b[1] * b[2], 0.0f, 0.0f} {}

    // Of the products of two corners, by the sums of a channel.
    static double product(const float* sums, int i, int j) {
        if (i != j) return sums[2 + i + j];
        return static_cast<double>(sums[i]) - sums[2 + i + (i + 1) % 3] - sums[2 + i + (i + 2) % 3];
    }
};

// Pictures have three channels nearly always: the compiler unrolls loops over so many.
template <class Body>
void with_channels(int32_t channels, const Body& body) {
    if (channels == 3) body(std::integral_constant<int32_t, 3>{});
    else body(channels);
}

template <class Channels>
class ShadeBackward {
public:
    ShadeBackward(const ShadeInput& in, Channels channels, const float* grad_shaded, const ShadeGradients& out)
        : in_(in), grad_shaded_(grad_shaded), out_(out), center_(in.camera), channels_(channels) {
        interpolates_ = in.colors_of == ColorsOf::kVertices || in.colors_of == ColorsOf::kCorners;
        moves_ = out.vertices && interpolates_;
    }

    BandSums gather(int band) const {
        BandSums sums;
        sums.background.assign(channels_, 0.0);
        {
            Places places(in_.mesh.num_faces, sums);
            const int32_t width = in_.camera.width, height = in_.camera.height;
            for (int32_t y = height * band / kBands; y < height * (band + 1) / kBands; ++y) {
                for_each_run(in_.triangle, width, y, [&](int32_t face, int64_t begin, int64_t end) {
                    run(face, begin, end, sums, places);
                });
            }
        }
        if (moves_) move(sums);
        return sums;
    }

    void add_up(const std::vector<BandSums>& bands) const {
        for (const BandSums& band : bands) {
            const float *sums = band.sums.data(), *moved = band.moved.data();
            for (const int64_t face : band.faces) {
                if (!interpolates_) add(sums, channels_, out_.colors + face * channels_);
                for (int i = 0; i < 3 && interpolates_; ++i) {
                    float* color = out_.colors ? out_.colors + in_.corner_color(face, i) : nullptr;
                    for (int32_t c = 0; c < channels_ && color; ++c) color[c] += sums[c * Weights::kCount + i];
                    const int64_t vertex = in_.mesh.faces[3 * face + i];
                    if (moves_) add(moved + 3 * i, std::integral_constant<int32_t, 3>{}, out_.vertices + 3 * vertex);
                }
                sums += sums_of_face();
                moved += 9;
            }
        }
        if (!out_.background) return;
        for (int32_t c = 0; c < channels_; ++c) {
            double total = 0.0;
            for (const BandSums& band : bands) total += band.background[c];
            out_.background[c] += static_cast<float>(total);
        }
    }

private:
    template <class Count>
    static void add(const float* from, Count count, float* to) {
        for (int32_t i = 0; i < count; ++i) to[i] += from[i];
    }

    // Pixels [begin, end) of a row see the same face, or none.
    void run(int32_t face, int64_t begin, int64_t end, BandSums& sums, Places& places) const {
        if (face < 0) {
            for (int64_t p = begin; p < end; ++p) {
                for (int32_t c = 0; c < channels_; ++c) sums.background[c] += grad_shaded_[p * channels_ + c];
            }
        } else if (in_.colors_of == ColorsOf::kPixels) {
            if (out_.colors) add(grad_shaded_ + begin * channels_, (end - begin) * channels_, out_.colors + begin * channels_);
        } else if (interpolates_ && (out_.colors || moves_)) {
            interpolated(begin, end, places.find(face, sums_of_face()));
        } else if (out_.colors) {
            float* into = places.find(face, channels_);
            for (int64_t p = begin; p < end; ++p) add(grad_shaded_ + p * channels_, channels_, into);
        }
    }

    int32_t sums_of_face() const { return interpolates_ ? channels_ * Weights::kCount : int32_t{channels_}; }

    void interpolated(int64_t begin, int64_t end, float* sums) const {
        for (int64_t p = begin; p < end; ++p) {
            const Weights weights(in_.barycentrics + 3 * p);
            for (int32_t c = 0; c < channels_; ++c) {
                const float g = grad_shaded_[p * channels_ + c];
                for (int i = 0; i < Weights::kCount; ++i) sums[c * Weights::kCount + i] += weights.of[i] * g;
            }
        }
    }

    // Asks for what `move` reads of a face: its corners lie anywhere in memory.
    void look_ahead(int64_t face) const {
        const int32_t* corners = in_.mesh.faces + 3 * face;
        for (int i = 0; i < 3; ++i) {
            prefetch(in_.mesh.vertices + 3 * static_cast<int64_t>(corners[i]));
            prefetch(in_.colors + in_.corner_color(face, i));
        }
    }

    // From sums to cotangents of places.
    void move(BandSums& band) const {
        band.moved.resize(9 * band.faces.size());
        const float* sums = band.sums.data();
        float* moved = band.moved.data();
        for (size_t number = 0; number < band.faces.size(); ++number) {
            if (number + kAhead < band.faces.size()) look_ahead(band.faces[number + kAhead]);
            const int64_t face = band.faces[number];
            const ViewInverse<double> inverse = center_.inverse(in_.mesh, face);
            const float* color[3];
            for (int i = 0; i < 3; ++i) color[i] = in_.colors + in_.corner_color(face, i);
            for (int m = 0; m < 3; ++m) {
                double pull[3] = {0.0, 0.0, 0.0}, mean = 0.0;
                for (int32_t c = 0; c < channels_; ++c) {
                    const float* of = sums + c * Weights::kCount;
                    for (int k = 1; k < 3; ++k) {
                        const double beside = static_cast<double>(color[k][c]) - color[0][c];
                        pull[k] += beside * of[m];
                        mean += beside * Weights::product(of, m, k);
                    }
                }
                const Vector3<double> u = (pull[0] - mean) * inverse.row[0] + (pull[1] - mean) * inverse.row[1] +
                                          (pull[2] - mean) * inverse.row[2];
                moved[3 * m] = static_cast<float>(-u.x);
                moved[3 * m + 1] = static_cast<float>(-u.y);
                moved[3 * m + 2] = static_cast<float>(-u.z);
            }
            sums += sums_of_face();
            moved += 9;
        }
    }

    const ShadeInput& in_;
    const float* grad_shaded_;
    const ShadeGradients& out_;
    Center center_;
    Channels channels_;
    bool interpolates_, moves_;
};

template <class Channels>
void shade_pixels(const ShadeInput& in, Channels channels, int64_t begin, int64_t end, float* shaded) {
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
}

}  // namespace

void shade(const ShadeInput& in, float* shaded) {
    const int64_t pixels = static_cast<int64_t>(in.camera.width) * in.camera.height;
    with_channels(in.channels, [&](auto channels) {
        parallel_for(pixels, 8192, [&](int64_t begin, int64_t end) { shade_pixels(in, channels, begin, end, shaded); });
    });
}

void shade_backward(const ShadeInput& input, const float* grad_shaded, const ShadeGradients& gradients) {
    with_channels(input.channels, [&](auto channels) {
        const ShadeBackward shading(input, channels, grad_shaded, gradients);
        std::vector<BandSums> bands(kBands);
        parallel_for(kBands, 1, [&](int64_t begin, int64_t end) {
            for (int64_t band = begin; band < end; ++band) bands[band] = shading.gather(static_cast<int>(band));
        });
        shading.add_up(bands);
    });
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
