// Attention between the channels of one Gaussian (the paper's Eq. 5): what the kernel and its callers share.
#pragma once

#include <cstdint>

namespace vlgs {

// Tokens are channels; those of colour stand before those of language. In self-attention all of them ask and
// all of them answer; in cross-attention language asks and colour answers.
struct AttentionShape {
  int64_t color, feature, heads, width;
  bool self;

  int64_t inputs() const { return color + feature; }
  int64_t first_query() const { return self ? 0 : color; }
  int64_t queries() const { return self ? inputs() : feature; }
  int64_t keys() const { return self ? inputs() : color; }
  int64_t inner(int64_t tokens) const { return tokens * heads * width; }
};

// Linear layers as PyTorch lays them out: weights [out, in], biases [out]. Rows of the maps are ordered
// (token, head, width), and those of key_value are all keys, then all values. P points to numbers, or counts
// them.
template <class P>
struct AttentionLayers {
  P query, query_bias, key_value, key_value_bias, out, out_bias;

  static constexpr int kCount = 6;
  P &operator[](int i) {
    P *const all[kCount] = {&query, &query_bias, &key_value, &key_value_bias, &out, &out_bias};
    return *all[i];
  }
};

inline AttentionLayers<int64_t> layer_sizes(const AttentionShape &s) {
  const int64_t query = s.inner(s.queries()), key_value = 2 * s.inner(s.keys());
  return {query * s.queries(), query, key_value * s.keys(), key_value, s.queries() * query, s.queries()};
}

template <class T>
struct Attention {
  AttentionShape shape;
  AttentionLayers<const T *> layers;
  const T *color, *feature;  // [n, channels]
};

// Colour and language [n, channels]. Cross-attention leaves colour as it is: there, fused colour and its
// gradient are null.
template <class P>
struct Fused {
  P color, feature;
};

// n Gaussians; the bits do not depend on the number of threads.
template <class T>
void attention(const Attention<T> &, int64_t n, Fused<T *> out, int threads);
template <class T>
void attention_backward(const Attention<T> &, int64_t n, Fused<const T *> d_out, Fused<T *> d_in,
                        AttentionLayers<T *> d_layers, int threads);

}  // namespace vlgs
