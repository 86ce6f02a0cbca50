// How it is scheduled. One view at a time: (1) vertices are projected and triangles set up in parallel, in double; (2)
// a stable counting sort, over fixed chunks of triangles, puts the triangles into square tiles of about 64 x 64 samples,
// so that each tile sees them in ascending index; (3) tiles run in parallel, each with its own z-buffer (32 KiB, in the
// L1 cache), and are resolved to final pixels at once: no buffer of the supersampled size exists. Strips of tile rows
// bound the memory of (2). Nothing depends on which thread runs what.
#include "rasterize_opaque.h"

#include <algorithm>
#include <utility>
#include <vector>

#include "instruction_set.h"
#include "math/opaque_triangle.h"
#include "opaque_pass.h"
#include "parallel.h"
#include "prefetch.h"
#include "scratch.h"

namespace etsplat {
namespace {

constexpr int kTileSamples = 64;
constexpr int64_t kStripEntries = 8'000'000;  // (tile, triangle) pairs in memory at a time
constexpr int32_t kAhead = 8;                 // pixels of a row: what they read lies anywhere in memory

struct Screen {
    Scratch<OpaqueVertex> vertices;
    Scratch<OpaqueBounds> bounds;       // empty where a triangle draws nothing
    Scratch<OpaqueTriangle> triangles;  // set up where bounds are not empty
    int32_t width, height;              // in samples
    int32_t tile, tiles_x, tiles_y;

    Screen(const OpaqueMesh& mesh, const OpaqueCamera& camera, int32_t samples, bool cull_backfaces)
        : vertices(mesh.num_vertices),
          bounds(mesh.num_faces),
          triangles(mesh.num_faces),
          width(camera.width * samples),
          height(camera.height * samples),
          tile(samples * std::max(1, kTileSamples / samples)),  // whole pixels
          tiles_x((width + tile - 1) / tile),
          tiles_y((height + tile - 1) / tile) {
        parallel_for(mesh.num_vertices, 4096, [&](int64_t begin, int64_t end) {
            for (int64_t v = begin; v < end; ++v) {
                vertices[v] = project_opaque(camera.viewmat, camera.K, camera.near_plane, samples, mesh.vertices + 3 * v);
            }
        });
        parallel_for(mesh.num_faces, 2048, [&](int64_t begin, int64_t end) {
            for (int64_t f = begin; f < end; ++f) {
                const int32_t* k = mesh.faces + 3 * f;
                const OpaqueVertex v[3] = {vertices[k[0]], vertices[k[1]], vertices[k[2]]};
                bounds[f] = opaque_bounds(v, width, height);
                if (!set_up_opaque(v, bounds[f], cull_backfaces, triangles[f])) bounds[f] = {0, 0, 0, 0};
            }
        });
    }
};

// Ends of strips of tile rows that hold at most kStripEntries pairs each, or are one row high.
std::vector<int32_t> strip_ends(const Screen& screen) {
    std::vector<int64_t> change(screen.tiles_y + 1, 0);
    for (const OpaqueBounds& t : screen.bounds) {
        if (t.empty()) continue;
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

// A bin for each layer of each tile of a strip, tile after tile.
struct Bins {
    std::vector<int64_t> begin;      // (bins + 1)
    std::vector<int32_t> triangles;  // ascending within a bin
};

template <int Layers, class Layer>
Bins bin_strip(const Screen& screen, const Layer& layer, int32_t row_begin, int32_t row_end) {
    const int64_t n = screen.bounds.size();
    const int64_t count = static_cast<int64_t>(row_end - row_begin) * screen.tiles_x * Layers;
    const int64_t chunk = std::max<int64_t>(4096, (n + 31) / 32), chunks = (n + chunk - 1) / chunk;
    std::vector<int64_t> places(chunks * count, 0);  // counts first, then the place of the chunk's next entry

    const auto for_each_pair = [&](int64_t c, auto&& visit) {
        for (int64_t f = c * chunk; f < std::min(n, (c + 1) * chunk); ++f) {
            const OpaqueBounds& t = screen.bounds[f];
            if (t.empty()) continue;
            const int32_t y0 = std::max(t.y_begin / screen.tile, row_begin);
            const int32_t y1 = std::min((t.y_end - 1) / screen.tile + 1, row_end);
            for (int32_t y = y0; y < y1; ++y) {
                for (int32_t x = t.x_begin / screen.tile; x <= (t.x_end - 1) / screen.tile; ++x) {
                    const int64_t tile = static_cast<int64_t>(y - row_begin) * screen.tiles_x + x;
                    visit(f, places[c * count + tile * Layers + layer(static_cast<int32_t>(f))]);
                }
            }
        }
    };
    parallel_for(chunks, 1, [&](int64_t begin, int64_t end) {
        for (int64_t c = begin; c < end; ++c) for_each_pair(c, [](int64_t, int64_t& entries) { ++entries; });
    });
    Bins bins;
    bins.begin.resize(count + 1);
    int64_t total = 0;
    for (int64_t bin = 0; bin < count; ++bin) {
        bins.begin[bin] = total;
        for (int64_t c = 0; c < chunks; ++c) total += std::exchange(places[c * count + bin], total);
    }
    bins.begin[count] = total;
    bins.triangles.resize(total);
    parallel_for(chunks, 1, [&](int64_t begin, int64_t end) {
        for (int64_t c = begin; c < end; ++c) {
            for_each_pair(c, [&](int64_t f, int64_t& place) { bins.triangles[place++] = static_cast<int32_t>(f); });
        }
    });
    return bins;
}

struct TileBuffer : OpaqueTile {
    std::vector<float> depths;
    std::vector<int32_t> owners;

    void reset(const Screen& screen, int32_t tile_x, int32_t tile_y) {
        x0 = tile_x * screen.tile;
        y0 = tile_y * screen.tile;
        x1 = std::min(x0 + screen.tile, screen.width);
        y1 = std::min(y0 + screen.tile, screen.height);
        width = screen.width;
        stride = screen.tile;
        const size_t size = static_cast<size_t>(stride) * stride + kMostAtATime - 1;
        depths.assign(size, 0.0f);
        owners.assign(size, -1);
        inverse_depth = depths.data();
        triangle = owners.data();
    }
};

// Draws each triangle into the buffer `layer` names, one of so many, and hands these to `resolve`.
template <int Layers, class Layer, class Resolve>
void for_each_tile(const Screen& screen, const Layer& layer, const Resolve& resolve) {
    const OpaqueKernels& kernels = active_opaque_kernels();
    int32_t row_begin = 0;
    for (const int32_t row_end : strip_ends(screen)) {
        const Bins bins = bin_strip<Layers>(screen, layer, row_begin, row_end);
        const int64_t tiles = static_cast<int64_t>(row_end - row_begin) * screen.tiles_x;
        parallel_for(tiles, 1, [&](int64_t begin, int64_t end) {
            thread_local TileBuffer buffers[Layers];
            for (int64_t tile = begin; tile < end; ++tile) {
                for (int k = 0; k < Layers; ++k) {
                    buffers[k].reset(screen, static_cast<int32_t>(tile % screen.tiles_x),
                                     row_begin + static_cast<int32_t>(tile / screen.tiles_x));
                    const int64_t first = bins.begin[tile * Layers + k], next = bins.begin[tile * Layers + k + 1];
                    kernels.draw(screen.triangles.begin(), bins.triangles.data() + first, next - first, buffers[k]);
                }
                resolve(buffers);
            }
        });
        row_begin = row_end;
    }
}

template <class Resolve>
void for_each_tile(const Screen& screen, const Resolve& resolve) {
    for_each_tile<1>(screen, [](int32_t) { return 0; }, [&](const TileBuffer* tile) { resolve(*tile); });
}

void barycentrics_at(const OpaqueMesh& mesh, const Screen& screen, int32_t face, int32_t x, int32_t y, float out[3]) {
    const int32_t* k = mesh.faces + 3 * static_cast<int64_t>(face);
    const OpaqueVertex v[3] = {screen.vertices[k[0]], screen.vertices[k[1]], screen.vertices[k[2]]};
    opaque_barycentrics(v, x, y, out);
}

// Asks for what `barycentrics_at` reads at pixels that follow `here` in a row: the corners of some, of later ones where
// these are found.
void look_ahead(const OpaqueMesh& mesh, const Screen& screen, const int32_t* here, int32_t following) {
    const auto face = [&](int32_t pixels) { return following > pixels ? here[pixels] : -1; };
    if (const int64_t later = face(2 * kAhead); later >= 0) prefetch(mesh.faces + 3 * later);
    if (const int64_t next = face(kAhead); next >= 0) {
        for (int k = 0; k < 3; ++k) prefetch(&screen.vertices[mesh.faces[3 * next + k]]);
    }
}

// What a tile shows to its place in the images.
void write_tile(const OpaqueMesh& mesh, const Screen& screen, const TileBuffer& tile, const OpaqueImages& to) {
    for (int32_t y = tile.y0; y < tile.y1; ++y) {
        const int64_t place = static_cast<int64_t>(y - tile.y0) * tile.stride - tile.x0;
        const int64_t row = static_cast<int64_t>(y) * screen.width;
        const int32_t* owners = tile.triangle + place;
        int32_t known = -1;  // whose corners are at hand
        OpaqueVertex v[3] = {};
        for (int32_t x = tile.x0; x < tile.x1; ++x) {
            const int32_t face = owners[x];
            to.triangle[row + x] = face;
            to.depth[row + x] = face < 0 ? 0.0f : 1.0f / tile.inverse_depth[place + x];
            if (!to.barycentrics) continue;
            look_ahead(mesh, screen, owners + x, tile.x1 - x);
            float* b = to.barycentrics + 3 * (row + x);
            b[0] = b[1] = b[2] = 0.0f;
            if (face < 0) continue;
            if (face != known) {
                known = face;
                const int32_t* k = mesh.faces + 3 * static_cast<int64_t>(face);
                for (int i = 0; i < 3; ++i) v[i] = screen.vertices[k[i]];
            }
            opaque_barycentrics(v, x, y, b);
        }
    }
}

// Swaps two layers that follow each other where the second is nearer. Of equally near triangles the smaller index is.
void bring_nearer(TileBuffer* layers, int second) {
    TileBuffer &a = layers[second - 1], &b = layers[second];
    const int64_t size = static_cast<int64_t>(a.y1 - a.y0) * a.stride;
    for (int64_t i = 0; i < size; ++i) {
        const float near = a.inverse_depth[i], other = b.inverse_depth[i];
        const int32_t here = a.triangle[i], there = b.triangle[i];
        const bool swaps = (other > near) | ((other == near) & (there < here));
        a.inverse_depth[i] = swaps ? other : near;
        b.inverse_depth[i] = swaps ? near : other;
        a.triangle[i] = swaps ? there : here;
        b.triangle[i] = swaps ? here : there;
    }
}

// Adds a sample's colour to `sum` (channels).
struct Shader {
    const OpaqueMesh& mesh;
    const OpaqueColors& colors;
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

void rasterize_opaque(const OpaqueMesh& mesh, const OpaqueCamera& camera, const OpaqueImages& nearest) {
    const Screen screen(mesh, camera, 1, false);
    for_each_tile(screen, [&](const TileBuffer& tile) { write_tile(mesh, screen, tile, nearest); });
}

void rasterize_behind(const OpaqueMesh& mesh, const OpaqueCamera& camera, const OpaqueImages& nearest,
                      const OpaqueImages& behind) {
    const Screen screen(mesh, camera, 1, false);
    for_each_tile<kOpaqueParts>(screen, opaque_part, [&](TileBuffer* parts) {
        for (int last = kOpaqueParts - 1; last > 0; --last) bring_nearer(parts, last);  // the nearest to the first
        for (int last = kOpaqueParts - 1; last > 1; --last) bring_nearer(parts, last);  // the next to the second
        write_tile(mesh, screen, parts[0], nearest);
        write_tile(mesh, screen, parts[1], behind);
    });
}

void enter_and_leave(const OpaqueMesh& mesh, const OpaqueCamera& camera, const bool* turned, int64_t* entered,
                     int64_t* left) {
    const Screen screen(mesh, camera, 1, false);
    const auto layer = [&](int32_t face) { return turned[face] ? 1 : 0; };
    for_each_tile<2>(screen, layer, [&](const TileBuffer* tiles) {
        const TileBuffer &facing = tiles[0], &back = tiles[1];
        for (int32_t y = facing.y0; y < facing.y1; ++y) {
            for (int32_t x = facing.x0; x < facing.x1; ++x) {
                const int64_t from = static_cast<int64_t>(y - facing.y0) * facing.stride + (x - facing.x0);
                const int32_t enters = facing.triangle[from], leaves = back.triangle[from];
                const float near = facing.inverse_depth[from], far = back.inverse_depth[from];
                const bool both = enters >= 0 && leaves >= 0 && (near > far || (near == far && enters < leaves));
                const int64_t to = static_cast<int64_t>(y) * screen.width + x;
                entered[to] = both ? enters : -1;
                left[to] = both ? leaves : -1;
            }
        }
    });
}

void render_opaque(const OpaqueMesh& mesh, const OpaqueCamera& camera, const OpaqueColors& colors,
                   int32_t supersampling, bool cull_backfaces, float* image) {
    const Screen screen(mesh, camera, supersampling, cull_backfaces);
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
