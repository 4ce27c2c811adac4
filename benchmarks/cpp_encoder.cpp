// The hash encoding's forward pass with Jacobian and its backward pass, as stages/neural/kernels.py has them: a chunk of
// points and a level at a time, first rows and positions, then the table; chunks in parallel forward, levels backward.
// benchmarks/cpp_encoder.py compiles and times it. Four features a level: a row is one vector.

#include <algorithm>
#include <cstdint>
#include <cstring>

typedef float Row __attribute__((vector_size(16)));
typedef uint32_t Index;

static const Index PRIME_Y = 2654435761u, PRIME_Z = 805459861u;
static const int CHUNK = 512;

struct Located {
    alignas(64) Index rows[8][CHUNK];
    alignas(64) float x[CHUNK], y[CHUNK], z[CHUNK];
};

static inline Row load(const float* from) {
    Row row;
    std::memcpy(&row, from, sizeof row);
    return row;
}

static inline void store(float* to, Row row) { std::memcpy(to, &row, sizeof row); }

template <bool DENSE>
static void locate(const float* points, int count, int resolution, Index offset, Index mask, Located& at) {
    const float half = 0.5f * resolution;
    const Index side = resolution + 1, slab = side * side;
#pragma omp simd
    for (int q = 0; q < count; q++) {
        const float px = (std::min(std::max(points[3 * q], -1.0f), 1.0f) + 1.0f) * half;
        const float py = (std::min(std::max(points[3 * q + 1], -1.0f), 1.0f) + 1.0f) * half;
        const float pz = (std::min(std::max(points[3 * q + 2], -1.0f), 1.0f) + 1.0f) * half;
        const int x = std::min(int(px), resolution - 1);
        const int y = std::min(int(py), resolution - 1);
        const int z = std::min(int(pz), resolution - 1);
        at.x[q] = px - x, at.y[q] = py - y, at.z[q] = pz - z;
        if (DENSE) {
            const Index base = (Index(x) * side + y) * side + z + offset;
            at.rows[0][q] = base, at.rows[1][q] = base + 1;
            at.rows[2][q] = base + side, at.rows[3][q] = base + side + 1;
            at.rows[4][q] = base + slab, at.rows[5][q] = base + slab + 1;
            at.rows[6][q] = base + slab + side, at.rows[7][q] = base + slab + side + 1;
        } else {
            const Index x0 = x, x1 = x + 1, y0 = y * PRIME_Y, y1 = y0 + PRIME_Y, z0 = z * PRIME_Z, z1 = z0 + PRIME_Z;
            at.rows[0][q] = offset + ((x0 ^ y0 ^ z0) & mask), at.rows[1][q] = offset + ((x0 ^ y0 ^ z1) & mask);
            at.rows[2][q] = offset + ((x0 ^ y1 ^ z0) & mask), at.rows[3][q] = offset + ((x0 ^ y1 ^ z1) & mask);
            at.rows[4][q] = offset + ((x1 ^ y0 ^ z0) & mask), at.rows[5][q] = offset + ((x1 ^ y0 ^ z1) & mask);
            at.rows[6][q] = offset + ((x1 ^ y1 ^ z0) & mask), at.rows[7][q] = offset + ((x1 ^ y1 ^ z1) & mask);
        }
    }
}

static void locate_level(
    const float* points, int count, const int64_t* resolutions, const int64_t* offsets, const uint8_t* dense, int level,
    Located& at) {
    const Index offset = offsets[level], mask = offsets[level + 1] - offset - 1;
    if (dense[level])
        locate<true>(points, count, resolutions[level], offset, mask, at);
    else
        locate<false>(points, count, resolutions[level], offset, mask, at);
}

template <bool WITH_JACOBIAN>
static void encode(
    const float* points, const float* table, const int64_t* resolutions, const int64_t* offsets, const uint8_t* dense,
    int active, int64_t num_points, int channels, float* features, float* jacobian) {
    const int64_t chunks = (num_points + CHUNK - 1) / CHUNK;
#pragma omp parallel for schedule(static)
    for (int64_t chunk = 0; chunk < chunks; chunk++) {
        Located at;
        const int64_t first = chunk * CHUNK;
        const int count = std::min<int64_t>(CHUNK, num_points - first);
        for (int level = 0; level < active; level++) {
            locate_level(points + 3 * first, count, resolutions, offsets, dense, level, at);
            const float scale = 0.5f * resolutions[level];
            for (int q = 0; q < count; q++) {
                const float fx = at.x[q], fy = at.y[q], fz = at.z[q];
                Row v[8];
                for (int k = 0; k < 8; k++) v[k] = load(table + 4 * size_t(at.rows[k][q]));
                const Row d00 = v[1] - v[0], d01 = v[3] - v[2], d10 = v[5] - v[4], d11 = v[7] - v[6];
                const Row c00 = v[0] + fz * d00, c01 = v[2] + fz * d01, c10 = v[4] + fz * d10, c11 = v[6] + fz * d11;
                const Row dy0 = c01 - c00, dy1 = c11 - c10;
                const Row c0 = c00 + fy * dy0, c1 = c10 + fy * dy1;
                store(features + (first + q) * channels + 4 * level, c0 + fx * (c1 - c0));
                if (WITH_JACOBIAN) {
                    const Row dz0 = d00 + fy * (d01 - d00), dz1 = d10 + fy * (d11 - d10);
                    float* out = jacobian + (first + q) * 3 * channels + 4 * level;
                    store(out, scale * (c1 - c0));
                    store(out + channels, scale * (dy0 + fx * (dy1 - dy0)));
                    store(out + 2 * channels, scale * (dz0 + fx * (dz1 - dz0)));
                }
            }
        }
        const int silent = (channels - 4 * active) * sizeof(float);
        for (int64_t p = first; silent && p < first + count; p++) {
            std::memset(features + p * channels + 4 * active, 0, silent);
            for (int axis = 0; WITH_JACOBIAN && axis < 3; axis++)
                std::memset(jacobian + (3 * p + axis) * channels + 4 * active, 0, silent);
        }
    }
}

template <bool OF_JACOBIAN>
static void add_gradient(
    const float* points, const int64_t* resolutions, const int64_t* offsets, const uint8_t* dense, int active,
    int64_t num_points, int channels, const float* grad_features, const float* grad_gradients, const float* cotangent,
    float* grad_table) {
    const int evens = (active + 1) / 2;
#pragma omp parallel for schedule(static)
    for (int index = 0; index < active; index++) {
        const int level = index < evens ? 2 * index : 2 * (index - evens) + 1;
        const float scale = 0.5f * resolutions[level];
        Located at;
        for (int64_t first = 0; first < num_points; first += CHUNK) {
            const int count = std::min<int64_t>(CHUNK, num_points - first);
            locate_level(points + 3 * first, count, resolutions, offsets, dense, level, at);
            for (int q = 0; q < count; q++) {
                const int64_t p = first + q;
                const float fx = at.x[q], fy = at.y[q], fz = at.z[q], gx = 1 - fx, gy = 1 - fy, gz = 1 - fz;
                const Row a = load(grad_features + p * channels + 4 * level);
                const float w[4] = {gx * gy, gx * fy, fx * gy, fx * fy};
                Row u = {}, ends[4];
                float e[4] = {}, sz = 0;
                if (OF_JACOBIAN) {
                    u = load(cotangent + p * channels + 4 * level);
                    const float sx = scale * grad_gradients[3 * p], sy = scale * grad_gradients[3 * p + 1];
                    sz = scale * grad_gradients[3 * p + 2];
                    e[0] = -sx * gy - sy * gx, e[1] = -sx * fy + sy * gx, e[2] = sx * gy - sy * fx, e[3] = sx * fy + sy * fx;
                }
                for (int k = 0; k < 4; k++) ends[k] = OF_JACOBIAN ? w[k] * a + e[k] * u : w[k] * a;
                for (int k = 0; k < 4; k++) {
                    const Row slope = w[k] * sz * u;
                    float* low = grad_table + 4 * size_t(at.rows[2 * k][q]);
                    store(low, load(low) + (gz * ends[k] - slope));
                    float* high = grad_table + 4 * size_t(at.rows[2 * k + 1][q]);
                    store(high, load(high) + (fz * ends[k] + slope));
                }
            }
        }
    }
}

extern "C" {
void encode_forward(
    const float* points, const float* table, const int64_t* resolutions, const int64_t* offsets, const uint8_t* dense,
    int active, int64_t num_points, int channels, float* features, float* jacobian) {
    (jacobian ? encode<true> : encode<false>)(
        points, table, resolutions, offsets, dense, active, num_points, channels, features, jacobian);
}

void encode_backward(
    const float* points, const int64_t* resolutions, const int64_t* offsets, const uint8_t* dense, int active,
    int64_t num_points, int channels, const float* grad_features, const float* grad_gradients, const float* cotangent,
    float* grad_table) {
    (grad_gradients ? add_gradient<true> : add_gradient<false>)(
        points, resolutions, offsets, dense, active, num_points, channels, grad_features, grad_gradients, cotangent,
        grad_table);
}
}
