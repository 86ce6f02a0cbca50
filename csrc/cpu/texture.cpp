// How it is scheduled. Samples are independent but for the gradient of the texels, where many of them meet. There, (1)
// each level is cut into tiles of texels, and chunks of samples count in parallel which tiles they touch, one nearly
// always; (2) the chunks write their samples' numbers into lists of the tiles, so that these have the order of the samples;
// (3) level by level, the coarsest first, tiles, or parts of a long list, add up their samples in double precision, each in
// memory of its own, in parallel; (4) parts are added in their order; (5) as a tile is written, what its texels hand on to
// those of the level before is added. What is added in which order depends on the samples alone. Samples whose cotangent
// is 0 are left out.
#include "texture.h"

#include <algorithm>
#include <cstdint>
#include <vector>

#include "parallel.h"

namespace etsplat {
namespace {

constexpr int kTile = 64;              // texels along each side
constexpr int64_t kPart = 1 << 16;     // samples of a list that are added up together
constexpr int64_t kLeastChunk = 1 << 14, kMostChunks = 64;
constexpr int64_t kSamples = 4096;     // that a thread takes at a time

// A level of what is laid out like a texture and its coarser levels.
float* level_of(const Texture& texture, float* base, float* coarser, int level) {
    if (level == 0) return base;
    return coarser + coarser_offset(texture.width, texture.height, level) * texture.channels;
}

struct LevelTiles {
    int width, height;   // of the level in texels
    int columns;         // of tiles
    int64_t first_tile;  // of all levels' tiles
};

// A part of the list of a tile.
struct Job {
    int level;
    int64_t tile, begin, end;
    bool whole;
};

class TexelGradient {
public:
    TexelGradient(const Texture& texture, const TextureSamples& samples, const float* grad, float* base, float* coarser)
        : texture_(texture), samples_(samples), grad_(grad), base_(base), coarser_(coarser) {
        int64_t tiles = 0;
        for (int level = 0; level < texture.levels; ++level) {
            const int width = texture.width >> level, height = texture.height >> level;
            const int columns = (width + kTile - 1) / kTile;
            levels_.push_back({width, height, columns, tiles});
            tiles += static_cast<int64_t>(columns) * ((height + kTile - 1) / kTile);
        }
        tiles_ = tiles;
        written_.assign(tiles, 0);
    }

    void run() {
        list_samples();
        for (int level = texture_.levels - 1; level >= 0; --level) add_up_level(level);
    }

private:
    void add_up_level(int level) {
        const std::vector<Job> jobs = find_jobs(level);
        std::vector<std::vector<double>> parts(jobs.size());
        parallel_for(static_cast<int64_t>(jobs.size()), 1, [&](int64_t begin, int64_t end) {
            std::vector<double> sums;
            for (int64_t j = begin; j < end; ++j) {
                add_up(jobs[j], sums);
                if (jobs[j].whole) write(jobs[j], sums);
                else parts[j] = sums;
            }
        });
        for (size_t j = 0; j < jobs.size();) {
            size_t next = j + 1;
            for (; next < jobs.size() && jobs[next].tile == jobs[j].tile; ++next) {
                for (size_t i = 0; i < parts[j].size(); ++i) parts[j][i] += parts[next][i];
            }
            if (!jobs[j].whole) write(jobs[j], parts[j]);
            j = next;
        }
    }

    // Calls visit(tile) for every tile that a sample adds to.
    template <class Visit>
    void for_each_tile(int64_t n, const Visit& visit) const {
        const float* g = grad_ + n * texture_.channels;
        if (std::all_of(g, g + texture_.channels, [](float value) { return value == 0.0f; })) return;
        LevelSample sample[2];
        const int count = samples_.levels(texture_, n, sample);
        for (int i = 0; i < count; ++i) {
            const LevelTiles& level = levels_[sample[i].level];
            for (int y = sample[i].y.first / kTile; y <= sample[i].y.second / kTile; ++y) {
                for (int x = sample[i].x.first / kTile; x <= sample[i].x.second / kTile; ++x) {
                    visit(level.first_tile + static_cast<int64_t>(y) * level.columns + x);
                }
            }
        }
    }

    void list_samples() {
        const int64_t chunk = std::max(kLeastChunk, (samples_.count + kMostChunks - 1) / kMostChunks);
        const int64_t chunks = (samples_.count + chunk - 1) / chunk;
        std::vector<int64_t> place(chunks * tiles_, 0);
        const auto for_each_chunk = [&](const auto& visit) {
            parallel_for(chunks, 1, [&](int64_t begin, int64_t end) {
                for (int64_t c = begin; c < end; ++c) {
                    for (int64_t n = c * chunk; n < std::min((c + 1) * chunk, samples_.count); ++n) {
                        for_each_tile(n, [&](int64_t tile) { visit(place[c * tiles_ + tile], n); });
                    }
                }
            });
        };
        for_each_chunk([](int64_t& count, int64_t) { ++count; });
        starts_.assign(tiles_ + 1, 0);
        int64_t total = 0;
        for (int64_t tile = 0; tile < tiles_; ++tile) {
            starts_[tile] = total;
            for (int64_t c = 0; c < chunks; ++c) {
                const int64_t count = place[c * tiles_ + tile];
                place[c * tiles_ + tile] = total;
                total += count;
            }
        }
        starts_[tiles_] = total;
        listed_.resize(total);
        for_each_chunk([this](int64_t& at, int64_t n) { listed_[at++] = static_cast<int32_t>(n); });
    }

    // In the order of tiles; every tile has one at least, since it is written even where nothing was added.
    std::vector<Job> find_jobs(int level) const {
        std::vector<Job> jobs;
        const int64_t last = level + 1 < texture_.levels ? levels_[level + 1].first_tile : tiles_;
        for (int64_t tile = levels_[level].first_tile; tile < last; ++tile) {
            const bool whole = starts_[tile + 1] - starts_[tile] <= kPart;
            int64_t begin = starts_[tile];
            do {
                const int64_t end = std::min(begin + kPart, starts_[tile + 1]);
                jobs.push_back({level, tile, begin, end, whole});
                begin = end;
            } while (begin < starts_[tile + 1]);
        }
        return jobs;
    }

    void add_up(const Job& job, std::vector<double>& sums) const {
        const LevelTiles& level = levels_[job.level];
        const int channels = texture_.channels;
        const auto index = static_cast<int>(job.tile - level.first_tile);
        const int left = index % level.columns * kTile, top = index / level.columns * kTile;
        if (job.begin == job.end) return sums.clear();
        sums.assign(static_cast<size_t>(kTile) * kTile * channels, 0.0);
        for (int64_t i = job.begin; i < job.end; ++i) {
            const int64_t n = listed_[i];
            LevelSample sample[2];
            const int count = samples_.levels(texture_, n, sample);
            const LevelSample& s = sample[count == 2 && sample[1].level == job.level ? 1 : 0];
            const float* g = grad_ + n * channels;
            float w[4];
            s.weights(w);
            for (int k = 0; k < 4; ++k) {
                const int x = (k & 1 ? s.x.second : s.x.first) - left, y = (k & 2 ? s.y.second : s.y.first) - top;
                if (w[k] == 0.0f || x < 0 || y < 0 || x >= kTile || y >= kTile) continue;
                double* into = sums.data() + (static_cast<int64_t>(y) * kTile + x) * channels;
                for (int c = 0; c < channels; ++c) into[c] += static_cast<double>(w[k]) * g[c];
            }
        }
    }

    // Of a whole tile; no sums are zeros. The next coarser level, whose texels are means of four, is written already.
    void write(const Job& job, const std::vector<double>& sums) {
        const LevelTiles& level = levels_[job.level];
        const int64_t index = job.tile - level.first_tile, channels = texture_.channels;
        const int64_t column = index % level.columns, line = index / level.columns;
        const int64_t left = column * kTile, top = line * kTile;
        const int64_t columns = std::min<int64_t>(kTile, level.width - left);
        const int64_t rows = std::min<int64_t>(kTile, level.height - top);
        const float* coarser = coarser_row(job.level, left, top, line / 2, column / 2);
        float* texels = level_of(texture_, base_, coarser_, job.level) + (top * level.width + left) * channels;
        written_[job.tile] = !sums.empty() || coarser;
        std::vector<float> handed(coarser ? columns * channels : 0);
        for (int64_t y = 0; y < rows; ++y) {
            float* to = texels + y * level.width * channels;
            if (sums.empty()) std::fill_n(to, columns * channels, 0.0f);
            else std::copy_n(sums.data() + y * kTile * channels, columns * channels, to);
            if (!coarser) continue;
            if (y % 2 == 0) {
                const float* from = coarser + y / 2 * (level.width / 2) * channels;
                for (int64_t x = 0; x < columns; ++x) {
                    for (int64_t c = 0; c < channels; ++c) handed[x * channels + c] = 0.25f * from[x / 2 * channels + c];
                }
            }
            for (int64_t i = 0; i < columns * channels; ++i) to[i] += handed[i];
        }
    }

    // The gradient of the coarser texels in front of a tile's first; null where they have none.
    const float* coarser_row(int level, int64_t left, int64_t top, int64_t line, int64_t column) const {
        if (level + 1 == texture_.levels) return nullptr;
        const LevelTiles& coarser = levels_[level + 1];
        if (!written_[coarser.first_tile + line * coarser.columns + column]) return nullptr;
        return level_of(texture_, base_, coarser_, level + 1) +
               (top / 2 * coarser.width + left / 2) * texture_.channels;
    }

    const Texture& texture_;
    const TextureSamples& samples_;
    const float* grad_;
    float *base_, *coarser_;
    std::vector<LevelTiles> levels_;
    int64_t tiles_;
    std::vector<int64_t> starts_;  // (tiles + 1): where the list of each tile begins
    std::vector<int32_t> listed_;  // samples
    std::vector<uint8_t> written_;  // of each tile, whether it has more than zeros
};

}  // namespace

void build_levels(const Texture& texture, float* coarser) {
    const int channels = texture.channels;
    for (int level = 1; level < texture.levels; ++level) {
        const int64_t width = texture.width >> level, height = texture.height >> level;
        const float* from = level_texels(texture, level - 1);
        float* to = level_of(texture, nullptr, coarser, level);
        parallel_for(height, 16, [&](int64_t begin, int64_t end) {
            for (int64_t y = begin; y < end; ++y) {
                for (int64_t x = 0; x < width; ++x) {
                    const float* upper = from + (4 * y * width + 2 * x) * channels;
                    const float* lower = upper + 2 * width * channels;
                    float* texel = to + (y * width + x) * channels;
                    for (int c = 0; c < channels; ++c) {
                        texel[c] = texel_mean(upper[c], upper[channels + c], lower[c], lower[channels + c]);
                    }
                }
            }
        });
    }
}

void sample_texture(const Texture& texture, const TextureSamples& samples, float* values) {
    parallel_for(samples.count, kSamples, [&](int64_t begin, int64_t end) {
        for (int64_t n = begin; n < end; ++n) {
            sample_texture(texture, samples.uv[2 * n], samples.uv[2 * n + 1], samples.detail(n),
                           values + n * texture.channels);
        }
    });
}

void sample_texture_by_uv(const Texture& texture, const TextureSamples& samples, const float* grad_values,
                          float* grad_uv) {
    parallel_for(samples.count, kSamples, [&](int64_t begin, int64_t end) {
        for (int64_t n = begin; n < end; ++n) {
            sample_texture_backward(texture, samples.uv[2 * n], samples.uv[2 * n + 1], samples.detail(n),
                                    grad_values + n * texture.channels, grad_uv + 2 * n);
        }
    });
}

void sample_texture_by_texels(const Texture& texture, const TextureSamples& samples, const float* grad_values,
                              float* grad_base, float* grad_coarser) {
    TexelGradient(texture, samples, grad_values, grad_base, grad_coarser).run();
}

}  // namespace etsplat
