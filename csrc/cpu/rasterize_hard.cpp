// How it is scheduled. One view at a time: (1) vertices are projected and triangles set up in parallel, in double; (2)
// a stable counting sort, over fixed chunks of triangles, puts the triangles into square tiles of about 64 x 64 samples,
// so that each tile sees them in ascending index; (3) tiles run in parallel, each with its own z-buffer (32 KiB, in the
// L1 cache), and are resolved to final pixels at once: no buffer of the supersampled size exists. Strips of tile rows
// bound the memory of (2). Nothing depends on which thread runs what.
//
// Coverage is the top-left rule by scan conversion. On the row of samples at height y, the edge from its upper end a to
// its lower end b crosses at x = a.x + (y - a.y) slope; it is active for a.y <= y < b.y, and a sample lies right of it
// if sample.x >= x. A triangle fills between the two edges active on a row. Neighbours compute the same number for
// their common edge, so that their spans meet without crack, whatever the rounding.
#include "rasterize_hard.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>
#include <vector>

#include "parallel.h"

namespace etsplat {
namespace {

constexpr int kTileSamples = 64;
constexpr int64_t kStripEntries = 8'000'000;  // (tile, triangle) pairs in memory at a time

struct Projected {
    double x, y, inverse_depth;  // in samples; inverse_depth is NaN where the vertex cannot be drawn
};

struct Edge {
    double x, y, slope, x_low, x_high;

    // Column of the first sample on the right side of the edge, clamped to [0, width].
    int32_t first_right(double sample_y, int32_t width) const {
        double at = x + (sample_y - y) * slope;
        at = at > x_low ? at : x_low;  // the edge's own range, so that both neighbours clamp alike (also a NaN)
        at = at < x_high ? at : x_high;
        at = std::min(std::max(at - 0.5, -1.0), static_cast<double>(width));
        const auto truncated = static_cast<int32_t>(at);
        return std::max(truncated + (at > truncated ? 1 : 0), 0);
    }
};

struct Triangle {
    Edge whole, upper, lower;  // from the top vertex to the bottom one, top to middle, middle to bottom
    double inverse_depth, inverse_depth_dx, inverse_depth_dy;  // plane, at the top vertex
    float inverse_depth_min, inverse_depth_max;
    int32_t x_begin, x_end, y_begin, y_end;  // samples; empty where the triangle draws nothing
};

struct Screen {
    std::vector<Projected> vertices;
    std::vector<Triangle> triangles;
    int32_t width, height;  // in samples
    int32_t tile, tiles_x, tiles_y;
};

Projected project(const HardCamera& camera, int32_t samples, const float* p) {
    const float* m = camera.viewmat;
    const float* k = camera.K;
    double c[3];
    for (int r = 0; r < 3; ++r) {
        c[r] = static_cast<double>(m[4 * r]) * p[0] + static_cast<double>(m[4 * r + 1]) * p[1] +
               static_cast<double>(m[4 * r + 2]) * p[2] + m[4 * r + 3];
    }
    Projected v;
    v.inverse_depth = 1.0 / c[2];
    v.x = samples * (k[0] * c[0] * v.inverse_depth + k[2]);
    v.y = samples * (k[4] * c[1] * v.inverse_depth + k[5]);
    const bool drawn = c[2] > static_cast<double>(camera.near_plane) && std::isfinite(v.x) && std::isfinite(v.y);
    if (!drawn) v.inverse_depth = std::numeric_limits<double>::quiet_NaN();
    return v;
}

Edge make_edge(const Projected& upper, const Projected& lower) {
    return {upper.x, upper.y, (lower.x - upper.x) / (lower.y - upper.y), std::min(upper.x, lower.x),
            std::max(upper.x, lower.x)};
}

int32_t first_sample(double coordinate, int32_t size) {
    return static_cast<int32_t>(std::min(std::max(std::ceil(coordinate - 0.5), 0.0), static_cast<double>(size)));
}

// Empty (x_end = 0) if it cannot be drawn: a vertex behind the near plane or not finite, no area, facing away.
Triangle set_up(const Projected* in, int32_t width, int32_t height, bool cull_backfaces) {
    Triangle t;
    t.x_begin = t.x_end = t.y_begin = t.y_end = 0;
    Projected v[3] = {in[0], in[1], in[2]};
    const double facing = (v[1].x - v[0].x) * (v[2].y - v[0].y) - (v[2].x - v[0].x) * (v[1].y - v[0].y);
    if (cull_backfaces && !(facing < 0.0)) return t;  // y points down: counter-clockwise is negative
    std::sort(v, v + 3, [](const Projected& a, const Projected& b) { return a.y < b.y || (a.y == b.y && a.x < b.x); });

    const double x1 = v[1].x - v[0].x, y1 = v[1].y - v[0].y, x2 = v[2].x - v[0].x, y2 = v[2].y - v[0].y;
    const double w1 = v[1].inverse_depth - v[0].inverse_depth, w2 = v[2].inverse_depth - v[0].inverse_depth;
    const double area = x1 * y2 - x2 * y1;
    t.inverse_depth = v[0].inverse_depth;
    t.inverse_depth_dx = (w1 * y2 - w2 * y1) / area;
    t.inverse_depth_dy = (x1 * w2 - x2 * w1) / area;
    if (!std::isfinite(t.inverse_depth_dx) || !std::isfinite(t.inverse_depth_dy)) return t;

    const auto [low, high] = std::minmax({v[0].inverse_depth, v[1].inverse_depth, v[2].inverse_depth});
    t.inverse_depth_min = static_cast<float>(low);
    t.inverse_depth_max = static_cast<float>(high);
    t.whole = make_edge(v[0], v[2]);
    t.upper = make_edge(v[0], v[1]);
    t.lower = make_edge(v[1], v[2]);
    t.y_begin = first_sample(v[0].y, height);
    t.y_end = first_sample(v[2].y, height);
    t.x_begin = first_sample(std::min(t.whole.x_low, v[1].x), width);
    t.x_end = first_sample(std::max(t.whole.x_high, v[1].x), width);
    return t;
}

bool draws(const Triangle& t) { return t.x_begin < t.x_end && t.y_begin < t.y_end; }

Screen set_up_screen(const HardMesh& mesh, const HardCamera& camera, int32_t samples, bool cull_backfaces) {
    Screen screen;
    screen.width = camera.width * samples;
    screen.height = camera.height * samples;
    screen.tile = samples * std::max(1, kTileSamples / samples);  // whole pixels
    screen.tiles_x = (screen.width + screen.tile - 1) / screen.tile;
    screen.tiles_y = (screen.height + screen.tile - 1) / screen.tile;
    screen.vertices.resize(mesh.num_vertices);
    parallel_for(mesh.num_vertices, 4096, [&](int64_t begin, int64_t end) {
        for (int64_t v = begin; v < end; ++v) screen.vertices[v] = project(camera, samples, mesh.vertices + 3 * v);
    });
    screen.triangles.resize(mesh.num_faces);
    parallel_for(mesh.num_faces, 2048, [&](int64_t begin, int64_t end) {
        for (int64_t f = begin; f < end; ++f) {
            const int32_t* k = mesh.faces + 3 * f;
            const Projected v[3] = {screen.vertices[k[0]], screen.vertices[k[1]], screen.vertices[k[2]]};
            screen.triangles[f] = set_up(v, screen.width, screen.height, cull_backfaces);
        }
    });
    return screen;
}

// Ends of strips of tile rows that hold at most kStripEntries pairs each, or are one row high.
std::vector<int32_t> strip_ends(const Screen& screen) {
    std::vector<int64_t> change(screen.tiles_y + 1, 0);
    for (const Triangle& t : screen.triangles) {
        if (!draws(t)) continue;
        const int64_t columns = (t.x_end - 1) / screen.tile - t.x_begin / screen.tile + 1;
        change[t.y_begin / screen.tile] += columns;
        change[(t.y_end - 1) / screen.tile + 1] -= columns;
    }
    std::vector<int32_t> ends;
    int64_t row_entries = 0, entries = 0;
    for (int32_t row = 0; row < screen.tiles_y; ++row) {
        row_entries += change[row];
        if (entries > 0 && entries + row_entries > kStripEntries) {
            ends.push_back(row);
            entries = 0;
        }
        entries += row_entries;
    }
    ends.push_back(screen.tiles_y);
    return ends;
}

struct Bins {
    std::vector<int64_t> begin;      // (tiles of the strip + 1)
    std::vector<int32_t> triangles;  // ascending within a tile
};

Bins bin_strip(const Screen& screen, int32_t row_begin, int32_t row_end) {
    const int64_t n = static_cast<int64_t>(screen.triangles.size());
    const int64_t tiles = static_cast<int64_t>(row_end - row_begin) * screen.tiles_x;
    const int64_t chunk = std::max<int64_t>(4096, (n + 31) / 32), chunks = (n + chunk - 1) / chunk;
    std::vector<int64_t> places(chunks * tiles, 0);  // counts first, then the place of the chunk's next entry

    const auto for_each_pair = [&](int64_t c, auto&& visit) {
        for (int64_t f = c * chunk; f < std::min(n, (c + 1) * chunk); ++f) {
            const Triangle& t = screen.triangles[f];
            if (!draws(t)) continue;
            const int32_t y0 = std::max(t.y_begin / screen.tile, row_begin);
            const int32_t y1 = std::min((t.y_end - 1) / screen.tile + 1, row_end);
            for (int32_t y = y0; y < y1; ++y) {
                for (int32_t x = t.x_begin / screen.tile; x <= (t.x_end - 1) / screen.tile; ++x) {
                    visit(f, places[c * tiles + static_cast<int64_t>(y - row_begin) * screen.tiles_x + x]);
                }
            }
        }
    };
    parallel_for(chunks, 1, [&](int64_t begin, int64_t end) {
        for (int64_t c = begin; c < end; ++c) for_each_pair(c, [](int64_t, int64_t& count) { ++count; });
    });
    Bins bins;
    bins.begin.resize(tiles + 1);
    int64_t total = 0;
    for (int64_t tile = 0; tile < tiles; ++tile) {
        bins.begin[tile] = total;
        for (int64_t c = 0; c < chunks; ++c) total += std::exchange(places[c * tiles + tile], total);
    }
    bins.begin[tiles] = total;
    bins.triangles.resize(total);
    parallel_for(chunks, 1, [&](int64_t begin, int64_t end) {
        for (int64_t c = begin; c < end; ++c) {
            for_each_pair(c, [&](int64_t f, int64_t& place) { bins.triangles[place++] = static_cast<int32_t>(f); });
        }
    });
    return bins;
}

struct TileBuffer {
    int32_t x0, y0, x1, y1;  // samples of the tile, clipped to the screen
    int32_t stride;
    std::vector<float> inverse_depth;
    std::vector<int32_t> triangle;

    void reset(const Screen& screen, int32_t tile_x, int32_t tile_y) {
        x0 = tile_x * screen.tile;
        y0 = tile_y * screen.tile;
        x1 = std::min(x0 + screen.tile, screen.width);
        y1 = std::min(y0 + screen.tile, screen.height);
        stride = screen.tile;
        inverse_depth.assign(static_cast<size_t>(stride) * stride, 0.0f);
        triangle.assign(static_cast<size_t>(stride) * stride, -1);
    }
};

// Triangles come in ascending index: a strict comparison lets the smaller index win a tie.
void draw(const Screen& screen, int32_t index, TileBuffer& tile) {
    const Triangle& t = screen.triangles[index];
    const auto slope = static_cast<float>(t.inverse_depth_dx);
    const int32_t y_end = std::min(t.y_end, tile.y1);
    for (int32_t y = std::max(t.y_begin, tile.y0); y < y_end; ++y) {
        const double sample_y = y + 0.5;
        const int32_t a = t.whole.first_right(sample_y, screen.width);
        const int32_t b = (sample_y < t.lower.y ? t.upper : t.lower).first_right(sample_y, screen.width);
        const int32_t begin = std::max(std::min(a, b), tile.x0), end = std::min(std::max(a, b), tile.x1);
        if (begin >= end) continue;
        const auto row = static_cast<float>(t.inverse_depth + t.inverse_depth_dy * (sample_y - t.whole.y) +
                                            t.inverse_depth_dx * (t.x_begin + 0.5 - t.whole.x));
        const int64_t place = static_cast<int64_t>(y - tile.y0) * tile.stride + (begin - tile.x0);
        float* depths = tile.inverse_depth.data() + place;
        int32_t* owners = tile.triangle.data() + place;
        const int32_t count = end - begin, offset = begin - t.x_begin;
        for (int32_t i = 0; i < count; ++i) {
            float w = row + slope * static_cast<float>(offset + i);  // the same number in every tile
            w = w < t.inverse_depth_min ? t.inverse_depth_min : w;   // slivers must not extrapolate
            w = w > t.inverse_depth_max ? t.inverse_depth_max : w;
            const bool nearer = w > depths[i];
            depths[i] = nearer ? w : depths[i];
            owners[i] = nearer ? index : owners[i];
        }
    }
}

template <class Resolve>
void for_each_tile(const Screen& screen, const Resolve& resolve) {
    int32_t row_begin = 0;
    for (const int32_t row_end : strip_ends(screen)) {
        const Bins bins = bin_strip(screen, row_begin, row_end);
        const int64_t tiles = static_cast<int64_t>(row_end - row_begin) * screen.tiles_x;
        parallel_for(tiles, 1, [&](int64_t begin, int64_t end) {
            thread_local TileBuffer buffer;
            for (int64_t tile = begin; tile < end; ++tile) {
                buffer.reset(screen, static_cast<int32_t>(tile % screen.tiles_x),
                             row_begin + static_cast<int32_t>(tile / screen.tiles_x));
                for (int64_t i = bins.begin[tile]; i < bins.begin[tile + 1]; ++i) {
                    draw(screen, bins.triangles[i], buffer);
                }
                resolve(buffer);
            }
        });
        row_begin = row_end;
    }
}

// Perspective-correct barycentrics b_k = (a_k / z_k) / sum_j (a_j / z_j), a clamped at 0, of the sample at column x and
// row y.
void barycentrics_at(const HardMesh& mesh, const Screen& screen, int32_t face, int32_t x, int32_t y, float out[3]) {
    Projected v[3];
    for (int k = 0; k < 3; ++k) {
        v[k] = screen.vertices[mesh.faces[3 * static_cast<int64_t>(face) + k]];
        v[k].x -= x + 0.5;
        v[k].y -= y + 0.5;
    }
    double weight[3];
    for (int k = 0; k < 3; ++k) {
        const Projected &p = v[(k + 1) % 3], &q = v[(k + 2) % 3];
        weight[k] = p.x * q.y - q.x * p.y;
    }
    const double sign = weight[0] + weight[1] + weight[2] < 0.0 ? -1.0 : 1.0;
    for (int k = 0; k < 3; ++k) weight[k] = std::max(sign * weight[k], 0.0) * v[k].inverse_depth;
    const double total = weight[0] + weight[1] + weight[2];
    for (int k = 0; k < 3; ++k) out[k] = total > 0.0 ? static_cast<float>(weight[k] / total) : 1.0f / 3.0f;
}

// Adds a sample's colour to `sum` (channels).
struct Shader {
    const HardMesh& mesh;
    const HardColors& colors;
    const Screen& screen;

    void add(int32_t face, int32_t x, int32_t y, float* sum) const {
        const int32_t channels = colors.channels;
        if (colors.faces) {
            const float* color = colors.faces + static_cast<int64_t>(face) * channels;
            for (int32_t c = 0; c < channels; ++c) sum[c] += color[c];
            return;
        }
        float b[3];
        barycentrics_at(mesh, screen, face, x, y, b);
        const float* color[3];
        for (int k = 0; k < 3; ++k) {
            const int64_t vertex = mesh.faces[3 * static_cast<int64_t>(face) + k];
            color[k] = colors.vertices + vertex * channels;
        }
        for (int32_t c = 0; c < channels; ++c) sum[c] += b[0] * color[0][c] + b[1] * color[1][c] + b[2] * color[2][c];
    }
};

}  // namespace

void rasterize_hard(const HardMesh& mesh, const HardCamera& camera, int32_t* triangle, float* barycentrics,
                    float* depth) {
    const Screen screen = set_up_screen(mesh, camera, 1, false);
    for_each_tile(screen, [&](const TileBuffer& tile) {
        for (int32_t y = tile.y0; y < tile.y1; ++y) {
            for (int32_t x = tile.x0; x < tile.x1; ++x) {
                const int64_t place = static_cast<int64_t>(y - tile.y0) * tile.stride + (x - tile.x0);
                const int64_t pixel = static_cast<int64_t>(y) * screen.width + x;
                const int32_t face = tile.triangle[place];
                float* b = barycentrics + 3 * pixel;
                triangle[pixel] = face;
                depth[pixel] = b[0] = b[1] = b[2] = 0.0f;
                if (face < 0) continue;
                barycentrics_at(mesh, screen, face, x, y, b);
                depth[pixel] = 1.0f / tile.inverse_depth[place];
            }
        }
    });
}

void render_opaque(const HardMesh& mesh, const HardCamera& camera, const HardColors& colors, int32_t supersampling,
                   bool cull_backfaces, float* image) {
    const Screen screen = set_up_screen(mesh, camera, supersampling, cull_backfaces);
    const Shader shader{mesh, colors, screen};
    const int32_t channels = colors.channels, s = supersampling;
    const float scale = 1.0f / static_cast<float>(s * s);
    for_each_tile(screen, [&](const TileBuffer& tile) {
        for (int32_t y0 = tile.y0; y0 < tile.y1; y0 += s) {
            for (int32_t x0 = tile.x0; x0 < tile.x1; x0 += s) {
                float* out = image + (static_cast<int64_t>(y0 / s) * camera.width + x0 / s) * (channels + 1);
                std::fill(out, out + channels + 1, 0.0f);
                for (int32_t y = y0; y < y0 + s; ++y) {
                    for (int32_t x = x0; x < x0 + s; ++x) {
                        const int32_t face =
                            tile.triangle[static_cast<int64_t>(y - tile.y0) * tile.stride + (x - tile.x0)];
                        if (face < 0) continue;
                        shader.add(face, x, y, out);
                        out[channels] += 1.0f;
                    }
                }
                for (int32_t c = 0; c <= channels; ++c) out[c] *= scale;
            }
        }
    });
}

}  // namespace etsplat
