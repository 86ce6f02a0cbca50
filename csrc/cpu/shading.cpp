// How it is scheduled. Forward: pixels are shaded in parallel. Backward: a fixed number of bands of rows gather the
// cotangents of colours and of interpolation, each for itself and only for what it shows, run by run of equal triangles; on
// one thread the bands are added up in their order. Nothing depends on which thread runs what.
#include "shading.h"

#include <algorithm>
#include <type_traits>
#include <vector>

#include "math/texture.h"
#include "parallel.h"

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
    explicit SparseRows(int32_t width) : width_(width) {}

    // Where the sums of a row begin. `places` has -1 for each row, at first.
    int64_t place(int64_t row, std::vector<int32_t>& places) {
        int32_t& found = places[row];
        if (found < 0) {
            rows_.push_back(row);
            sums_.resize(sums_.size() + width_, 0.0f);
            found = static_cast<int32_t>(rows_.size()) - 1;
        }
        return static_cast<int64_t>(found) * width_;
    }
    float* at(int64_t place) { return sums_.data() + place; }

    void forget(std::vector<int32_t>& places) const {
        for (const int64_t row : rows_) places[row] = -1;
    }

    // Columns [begin, begin + columns) of all sums to as wide rows.
    void add_to(float* out, int32_t begin, int32_t columns) const {
        const float* from = sums_.data() + begin;
        for (const int64_t row : rows_) {
            for (int32_t i = 0; i < columns; ++i) out[row * columns + i] += from[i];
            from += width_;
        }
    }

private:
    int32_t width_;
    std::vector<int64_t> rows_;
    std::vector<float> sums_;
};

// Where a thread looks places up: -1 throughout between bands, so that no band has to fill them.
struct Places {
    std::vector<int32_t> colors, vertices;

    static Places& of_this_thread(int64_t colors, int64_t vertices) {
        thread_local Places places;
        if (static_cast<int64_t>(places.colors.size()) < colors) places.colors.resize(colors, -1);
        if (static_cast<int64_t>(places.vertices.size()) < vertices) places.vertices.resize(vertices, -1);
        return places;
    }
};

// Cotangents of one band of rows. Those of a vertex' colour and of its place are one row, if both are asked for.
struct BandSums {
    SparseRows colors, vertices;
    std::vector<double> background;

    // Leaves the tables of its thread as they were.
    struct Gathering {
        const BandSums& sums;
        Places& places;

        ~Gathering() {
            sums.colors.forget(places.colors);
            sums.vertices.forget(places.vertices);
        }
    };
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
        const int64_t faces = in.mesh.num_faces, vertices = in.mesh.num_vertices;
        interpolates_ = in.colors_of == ColorsOf::kVertices || in.colors_of == ColorsOf::kCorners;
        moves_ = out.vertices && interpolates_;
        together_ = moves_ && out.colors && in.colors_of == ColorsOf::kVertices;
        moved_rows_ = moves_ && !together_ ? vertices : 0;
        colored_rows_ = 0;
        if (!out.colors) return;
        if (in.colors_of == ColorsOf::kFaces) colored_rows_ = faces;
        if (in.colors_of == ColorsOf::kVertices) colored_rows_ = vertices;
        if (in.colors_of == ColorsOf::kCorners) colored_rows_ = 3 * faces;
    }

    BandSums nothing() const {
        return {SparseRows(channels_ + (together_ ? 3 : 0)), SparseRows(3), std::vector<double>(channels_, 0.0)};
    }

    void gather(int band, BandSums& sums) const {
        Places& places = Places::of_this_thread(colored_rows_, moved_rows_);
        const BandSums::Gathering gathering{sums, places};
        const int32_t width = in_.camera.width, height = in_.camera.height;
        for (int32_t y = height * band / kBands; y < height * (band + 1) / kBands; ++y) {
            for_each_run(in_.triangle, width, y, [&](int32_t face, int64_t begin, int64_t end) {
                run(face, begin, end, sums, places);
            });
        }
    }

    void add_up(const std::vector<BandSums>& bands) const {
        for (const BandSums& band : bands) {
            if (out_.colors) band.colors.add_to(out_.colors, 0, channels_);
            if (together_) band.colors.add_to(out_.vertices, channels_, 3);
            else if (moves_) band.vertices.add_to(out_.vertices, 0, 3);
        }
        if (!out_.background) return;
        for (int32_t c = 0; c < channels_; ++c) {
            double total = 0.0;
            for (const BandSums& band : bands) total += band.background[c];
            out_.background[c] += static_cast<float>(total);
        }
    }

private:
    // Pixels [begin, end) of a row see the same face, or none.
    void run(int32_t face, int64_t begin, int64_t end, BandSums& sums, Places& places) const {
        if (face >= 0 && interpolates_) return interpolated(face, begin, end, sums, places);
        if (face >= 0 && !out_.colors) return;
        const int64_t size = (end - begin) * channels_;
        const float* grad = grad_shaded_ + begin * channels_;
        if (face >= 0 && in_.colors_of == ColorsOf::kPixels) {
            for (int64_t i = 0; i < size; ++i) out_.colors[begin * channels_ + i] += grad[i];
            return;
        }
        float* into = face < 0 ? nullptr : sums.colors.at(sums.colors.place(face, places.colors));
        for (int64_t p = begin; p < end; ++p) {
            const float* g = grad_shaded_ + p * channels_;
            for (int32_t c = 0; c < channels_; ++c) {
                if (face < 0) sums.background[c] += g[c];
                else into[c] += g[c];
            }
        }
    }

    void interpolated(int64_t face, int64_t begin, int64_t end, BandSums& sums, Places& places) const {
        const float* color[3];
        int64_t into[3] = {0, 0, 0};
        float* summed[3];
        for (int i = 0; i < 3; ++i) {
            const int64_t from = in_.corner_color(face, i);
            color[i] = in_.colors + from;
            if (out_.colors) into[i] = sums.colors.place(from / channels_, places.colors);
        }
        for (int i = 0; i < 3; ++i) summed[i] = sums.colors.at(into[i]);
        ViewInverse<double> inverse;
        if (moves_) inverse = center_.inverse(in_.mesh, face);
        Vector3<double> moved[3] = {};
        for (int64_t p = begin; p < end; ++p) {
            const float* g = grad_shaded_ + p * channels_;
            double b[3], cotangent[3] = {0.0, 0.0, 0.0};
            for (int i = 0; i < 3; ++i) {
                b[i] = in_.barycentrics[3 * p + i];
                for (int32_t c = 0; c < channels_; ++c) {
                    if (out_.colors) summed[i][c] += static_cast<float>(b[i]) * g[c];
                    cotangent[i] += static_cast<double>(g[c]) * color[i][c];
                }
            }
            if (!moves_) continue;
            const Vector3<double> u = interpolation_derivative(inverse, b, cotangent);
            for (int i = 0; i < 3; ++i) moved[i] = moved[i] - b[i] * u;
        }
        for (int i = 0; moves_ && i < 3; ++i) {
            float* into_vertex = together_ ? summed[i] + channels_ : moved_sums(face, i, sums, places);
            into_vertex[0] += static_cast<float>(moved[i].x);
            into_vertex[1] += static_cast<float>(moved[i].y);
            into_vertex[2] += static_cast<float>(moved[i].z);
        }
    }

    float* moved_sums(int64_t face, int corner, BandSums& sums, Places& places) const {
        return sums.vertices.at(sums.vertices.place(in_.mesh.faces[3 * face + corner], places.vertices));
    }

    const ShadeInput& in_;
    const float* grad_shaded_;
    const ShadeGradients& out_;
    Center center_;
    Channels channels_;
    int64_t colored_rows_, moved_rows_;
    bool interpolates_, moves_, together_;
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
        std::vector<BandSums> bands(kBands, shading.nothing());
        parallel_for(kBands, 1, [&](int64_t begin, int64_t end) {
            for (int64_t band = begin; band < end; ++band) shading.gather(static_cast<int>(band), bands[band]);
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
