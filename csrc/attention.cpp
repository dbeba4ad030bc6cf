// u = x + out(softmax(Q K^T / sqrt(width)) V) inside every Gaussian, and its derivative. One lane is one
// Gaussian: every product below is the same instruction for sixteen of them, and the result of a
// Gaussian does not depend on its neighbours. The backward pass computes queries, keys, values and shares
// again, which is cheaper than storing them.
#include <cmath>
#include <limits>

#include "isa.h"
#include "simd.h"

namespace vlgs::VLGS_ISA_NS {
namespace {

// Packs of Gaussians at a time. A sum over Gaussians is kept per lane and goes through memory once per block.
constexpr int kPacks = 4;
constexpr int64_t kRow = kPacks * kLanes;

// Row r of a block of numbers [rows, kRow], pack p.
template <class T>
VLGS_INLINE T *at(T *block, int64_t r, int p) {
  return block + r * kRow + p * kLanes;
}

template <class T>
VLGS_INLINE Pack<T> max(const Pack<T> &a, const Pack<T> &b) {
  return select(a <= b, b, a);
}

// A matrix by its strides, so that a transposed one is read in place.
template <class T>
struct Matrix {
  const T *data;
  int64_t out_stride, in_stride;
};
template <class T>
Matrix<T> straight(const T *data, int64_t in) {
  return {data, in, 1};
}
template <class T>
Matrix<T> transposed(const T *data, int64_t out) {
  return {data, 1, out};
}

enum class Start { kBias, kZero, kAdd };

template <int R, Start S, class T>
VLGS_INLINE void multiply_rows(const Matrix<T> &m, const T *bias, const T *x, int64_t in, T *y, int64_t first,
                               int p) {
  Pack<T> sum[R];
  for (int r = 0; r < R; ++r) {
    if constexpr (S == Start::kBias) sum[r] = splat(bias[first + r]);
    if constexpr (S == Start::kZero) sum[r] = splat(T(0));
    if constexpr (S == Start::kAdd) sum[r] = load(at(y, first + r, p));
  }
  const T *w = m.data + first * m.out_stride;
  for (int64_t i = 0; i < in; ++i) {
    const Pack<T> value = load(at(x, i, p));
    for (int r = 0; r < R; ++r) sum[r] = fma(splat(w[r * m.out_stride + i * m.in_stride]), value, sum[r]);
  }
  for (int r = 0; r < R; ++r) store(at(y, first + r, p), sum[r]);
}

// y = m x + bias, m x or y + m x for blocks of columns x [in, kRow] and y [out, kRow].
template <Start S, class T>
void multiply(const Matrix<T> &m, const T *bias, const T *x, int64_t in, T *y, int64_t out) {
  for (int p = 0; p < kPacks; ++p) {
    int64_t first = 0;
    for (; first + 4 <= out; first += 4) multiply_rows<4, S>(m, bias, x, in, y, first, p);
    for (; first < out; ++first) multiply_rows<1, S>(m, bias, x, in, y, first, p);
  }
}

template <int R, int C, class T>
VLGS_INLINE void add_products(const T *y, const T *x, int64_t columns, T *sums) {
  Pack<T> sum[R][C];
  for (int r = 0; r < R; ++r)
    for (int c = 0; c < C; ++c) sum[r][c] = load(sums + (r * columns + c) * kLanes);
  for (int p = 0; p < kPacks; ++p) {
    Pack<T> right[C];
    for (int c = 0; c < C; ++c) right[c] = load(at(x, c, p));
    for (int r = 0; r < R; ++r) {
      const Pack<T> left = load(at(y, r, p));
      for (int c = 0; c < C; ++c) sum[r][c] = fma(left, right[c], sum[r][c]);
    }
  }
  for (int r = 0; r < R; ++r)
    for (int c = 0; c < C; ++c) store(sums + (r * columns + c) * kLanes, sum[r][c]);
}

// sums[r, c] += y[r] x[c] and biases[r] += y[r] over the Gaussians of a block, lane by lane.
template <class T>
void add_gradients(const T *y, int64_t rows, const T *x, int64_t columns, T *sums, T *biases) {
  for (int64_t r = 0; r < rows; ++r) {
    Pack<T> sum = load(biases + r * kLanes);
    for (int p = 0; p < kPacks; ++p) sum = sum + load(at(y, r, p));
    store(biases + r * kLanes, sum);
  }
  int64_t r = 0;
  const auto across = [&]<int R>() {
    int64_t c = 0;
    const T *from = y + r * kRow;
    T *to = sums + r * columns * kLanes;
    for (; c + 2 <= columns; c += 2) add_products<R, 2>(from, x + c * kRow, columns, to + c * kLanes);
    for (; c < columns; ++c) add_products<R, 1>(from, x + c * kRow, columns, to + c * kLanes);
  };
  for (; r + 4 <= rows; r += 4) across.template operator()<4>();
  for (; r < rows; ++r) across.template operator()<1>();
}

// The blocks that a scratch array is cut into, each [rows, kRow].
template <class T>
struct Blocks {
  int64_t queries, keys;  // rows of q and mixed, of k and v
  T *x, *q, *kv, *mixed, *shares;
  T *u;  // in backward its gradient
  T *d_x, *d_q, *d_kv, *d_mixed;

  Blocks(const AttentionShape &s, T *scratch) : queries(s.inner(s.queries())), keys(s.inner(s.keys())) {
    const auto take = [&](int64_t rows) {
      T *piece = scratch;
      scratch += rows * kRow;
      return piece;
    };
    x = take(s.inputs()), q = take(queries), kv = take(2 * keys), mixed = take(queries);
    shares = take(2 * s.keys());
    u = take(s.inputs()), d_x = take(s.inputs());
    d_q = take(queries), d_kv = take(2 * keys), d_mixed = take(queries);
    end = scratch;
  }
  T *end;
};

// Rows [begin, end) of [n, channels] as the first `channels` rows of a block; zeros beyond the end.
template <class T>
void gather(const T *rows, int64_t channels, int64_t begin, int64_t end, T *block) {
  for (int64_t g = 0; g < kRow; ++g)
    for (int64_t c = 0; c < channels; ++c)
      block[c * kRow + g] = begin + g < end ? rows[(begin + g) * channels + c] : T(0);
}
template <class T>
void scatter(const T *block, int64_t channels, int64_t begin, int64_t end, T *rows) {
  for (int64_t g = 0; g < kRow && begin + g < end; ++g)
    for (int64_t c = 0; c < channels; ++c) rows[(begin + g) * channels + c] = block[c * kRow + g];
}

// Tokens of a Gaussian inside a block: the row of (token, head, 0).
struct Heads {
  int64_t heads, width;
  int64_t row(int64_t token, int64_t head) const { return (token * heads + head) * width; }
};

template <class T>
VLGS_INLINE Pack<T> dot(const T *a, const T *b, int64_t width, int p) {
  Pack<T> sum = load(at(a, 0, p)) * load(at(b, 0, p));
  for (int64_t e = 1; e < width; ++e) sum = fma(load(at(a, e, p)), load(at(b, e, p)), sum);
  return sum;
}

// shares[j] = softmax over j of q . k_j / sqrt(width). Less the largest score, nothing overflows.
template <class T>
VLGS_INLINE void share_out(const T *q, const T *keys, const AttentionShape &s, const Heads &rows,
                           int64_t head, int64_t width, int p, T *shares) {
  const T octaves = T(1.4426950408889634 / std::sqrt(double(width)));
  // What lies below is less than the last bit of a sum that holds a one.
  const Pack<T> floor = splat(T(126));
  const int64_t count = s.keys();
  Pack<T> largest = splat(-std::numeric_limits<T>::infinity());
  for (int64_t j = 0; j < count; ++j) {
    const Pack<T> score = dot(q, at(keys, rows.row(j, head), 0), width, p);
    store(shares + j * kLanes, score);
    largest = max(largest, score);
  }
  Pack<T> sum = splat(T(0));
  for (int64_t j = 0; j < count; ++j) {
    const Pack<T> below = (largest - load(shares + j * kLanes)) * splat(octaves);
    const Pack<T> share = exp2_of_minus(min(floor, below));
    store(shares + j * kLanes, share);
    sum = sum + share;
  }
  const Pack<T> scale = reciprocal(sum);
  for (int64_t j = 0; j < count; ++j) store(shares + j * kLanes, load(shares + j * kLanes) * scale);
}

// mixed = sum_j shares[j] value_j
template <class T>
VLGS_INLINE void mix(const T *shares, const T *values, int64_t count, const Heads &rows, int64_t head,
                     int64_t width, int p, T *mixed) {
  for (int64_t e = 0; e < width; ++e) {
    Pack<T> sum = splat(T(0));
    for (int64_t j = 0; j < count; ++j)
      sum = fma(load(shares + j * kLanes), load(at(values, rows.row(j, head) + e, p)), sum);
    store(at(mixed, e, p), sum);
  }
}

// Everything before the output layer; W is the width where it is known beforehand, else 0.
template <int W, class T>
void attend(const AttentionShape &s, const Blocks<T> &b) {
  const int64_t width = W ? W : s.width;
  const Heads rows{s.heads, width};
  for (int p = 0; p < kPacks; ++p)
    for (int64_t i = 0; i < s.queries(); ++i)
      for (int64_t h = 0; h < s.heads; ++h) {
        const int64_t row = rows.row(i, h);
        share_out(at(b.q, row, 0), b.kv, s, rows, h, width, p, b.shares);
        mix(b.shares, at(b.kv, b.keys, 0), s.keys(), rows, h, width, p, at(b.mixed, row, 0));
      }
}

// From the gradient of mixed to those of queries, keys and values; computes mixed on the way.
template <int W, class T>
void attend_backward(const AttentionShape &s, const Blocks<T> &b) {
  const int64_t width = W ? W : s.width, count = s.keys();
  const Heads rows{s.heads, width};
  const T inv_root = T(1 / std::sqrt(double(width)));
  const T *values = at(b.kv, b.keys, 0);
  T *d_values = at(b.d_kv, b.keys, 0), *d_shares = b.shares + count * kLanes;
  for (int64_t k = 0; k < 2 * b.keys * kRow; ++k) b.d_kv[k] = 0;
  for (int p = 0; p < kPacks; ++p)
    for (int64_t i = 0; i < s.queries(); ++i)
      for (int64_t h = 0; h < s.heads; ++h) {
        const int64_t row = rows.row(i, h);
        const T *q = at(b.q, row, 0), *d_mixed = at(b.d_mixed, row, 0);
        share_out(q, b.kv, s, rows, h, width, p, b.shares);
        mix(b.shares, values, count, rows, h, width, p, at(b.mixed, row, 0));
        Pack<T> mean = splat(T(0));
        for (int64_t j = 0; j < count; ++j) {
          const Pack<T> d_share = dot(d_mixed, at(values, rows.row(j, h), 0), width, p);
          store(d_shares + j * kLanes, d_share);
          mean = fma(load(b.shares + j * kLanes), d_share, mean);
        }
        for (int64_t e = 0; e < width; ++e) store(at(b.d_q, row + e, p), splat(T(0)));
        for (int64_t j = 0; j < count; ++j) {
          const Pack<T> share = load(b.shares + j * kLanes);
          const Pack<T> d_score = (load(d_shares + j * kLanes) - mean) * share * splat(inv_root);
          for (int64_t e = 0; e < width; ++e) {
            const int64_t key = rows.row(j, h) + e;
            T *d_q = at(b.d_q, row + e, p), *d_k = at(b.d_kv, key, p), *d_v = at(d_values, key, p);
            store(d_q, fma(d_score, load(at(b.kv, key, p)), load(d_q)));
            store(d_k, fma(d_score, load(at(q, e, p)), load(d_k)));
            store(d_v, fma(share, load(at(d_mixed, e, p)), load(d_v)));
          }
        }
      }
}

// Loads a block of Gaussians and maps it to queries, keys and values.
template <class T>
void read_block(const Attention<T> &a, int64_t begin, int64_t end, const Blocks<T> &b) {
  const AttentionShape &s = a.shape;
  gather(a.color, s.color, begin, end, b.x);
  gather(a.feature, s.feature, begin, end, at(b.x, s.color, 0));
  const T *asking = at(b.x, s.first_query(), 0);
  multiply<Start::kBias>(straight(a.layers.query, s.queries()), a.layers.query_bias, asking, s.queries(), b.q,
                         b.queries);
  multiply<Start::kBias>(straight(a.layers.key_value, s.keys()), a.layers.key_value_bias, b.x, s.keys(), b.kv,
                         2 * b.keys);
}

}  // namespace

int64_t attention_scratch(const AttentionShape &s) {
  T *const start = nullptr;
  return Blocks<T>(s, start).end - start;
}

void attention(const Attention<T> &a, Fused<T *> out, int64_t begin, int64_t end, T *scratch) {
  const AttentionShape &s = a.shape;
  const Blocks<T> b(s, scratch);
  for (; begin < end; begin += kRow) {
    read_block(a, begin, end, b);
    switch (s.width) {
      case 1:
        attend<1>(s, b);
        break;
      case 4:
        attend<4>(s, b);
        break;
      default:
        attend<0>(s, b);
    }
    multiply<Start::kBias>(straight(a.layers.out, b.queries), a.layers.out_bias, b.mixed, b.queries, b.u,
                           s.queries());
    for (int64_t c = 0; c < s.queries(); ++c)
      for (int p = 0; p < kPacks; ++p)
        store(at(b.u, c, p), load(at(b.x, s.first_query() + c, p)) + load(at(b.u, c, p)));
    if (out.color) scatter(b.u, s.color, begin, end, out.color);
    scatter(at(b.u, s.color - s.first_query(), 0), s.feature, begin, end, out.feature);
  }
}

void attention_backward(const Attention<T> &a, Fused<const T *> d_out, Fused<T *> d_in, int64_t begin,
                        int64_t end, T *scratch, AttentionLayers<T *> sums) {
  const AttentionShape &s = a.shape;
  const Blocks<T> b(s, scratch);
  for (; begin < end; begin += kRow) {
    read_block(a, begin, end, b);
    // The residual: what the fused channels get goes on to the channels themselves. Colour is null, and gets
    // nothing that way, in cross-attention.
    if (d_out.color)
      gather(d_out.color, s.color, begin, end, b.d_x);
    else
      for (int64_t k = 0; k < s.color * kRow; ++k) b.d_x[k] = 0;
    gather(d_out.feature, s.feature, begin, end, at(b.d_x, s.color, 0));
    T *d_asking = at(b.d_x, s.first_query(), 0);
    for (int64_t k = 0; k < s.queries() * kRow; ++k) b.u[k] = d_asking[k];

    multiply<Start::kZero>(transposed(a.layers.out, b.queries), a.layers.out_bias, b.u, s.queries(),
                           b.d_mixed, b.queries);
    switch (s.width) {
      case 1:
        attend_backward<1>(s, b);
        break;
      case 4:
        attend_backward<4>(s, b);
        break;
      default:
        attend_backward<0>(s, b);
    }
    multiply<Start::kAdd>(transposed(a.layers.query, s.queries()), a.layers.query_bias, b.d_q, b.queries,
                          d_asking, s.queries());
    multiply<Start::kAdd>(transposed(a.layers.key_value, s.keys()), a.layers.key_value_bias, b.d_kv,
                          2 * b.keys, b.d_x, s.keys());
    add_gradients(b.d_q, b.queries, at(b.x, s.first_query(), 0), s.queries(), sums.query, sums.query_bias);
    add_gradients(b.d_kv, 2 * b.keys, b.x, s.keys(), sums.key_value, sums.key_value_bias);
    add_gradients(b.u, s.queries(), b.mixed, b.queries, sums.out, sums.out_bias);
    scatter(b.d_x, s.color, begin, end, d_in.color);
    scatter(at(b.d_x, s.color, 0), s.feature, begin, end, d_in.feature);
  }
}

}  // namespace vlgs::VLGS_ISA_NS
