// The kernels of one instruction set; see kernels.h for what they do.
#pragma once

#include "kernels.h"

#if !defined(VLGS_ISA_NS) || !defined(VLGS_NUMBER)
#error "compile the kernels with -DVLGS_ISA_NS=<name> -DVLGS_NUMBER=<float or double>"
#endif

namespace vlgs::VLGS_ISA_NS {

using Number = VLGS_NUMBER;

template <class T>
void project(const Camera &, Gaussians<T>, Splats<T>, int64_t begin, int64_t end);
template <class T>
void project_backward(const Camera &, Gaussians<T>, GaussianGrads<T>, int64_t begin, int64_t end);
template <class T>
void boxes(Grid, int64_t count, const T *mean2d, const T *ellipse, T octaves, const T *cutoffs, Box *);
template <class T>
void cover(Grid, const T *record, T cutoff, Box, uint16_t *masks);
template <class T>
int64_t blend_scratch(const Pass<T> &, int64_t list_length);
template <class T>
int64_t backward_scratch(const Pass<T> &, int64_t list_length);
template <class T>
void blend(const Pass<T> &, int64_t tile, T *scratch, uint32_t *list);
template <class T>
bool blend_backward(const Pass<T> &, int64_t tile, T *scratch, T *slots);
template <class T>
int64_t attention_scratch(const AttentionShape &);
template <class T>
void attention(const Attention<T> &, Fused<T *> out, int64_t begin, int64_t end, T *scratch);
template <class T>
void attention_backward(const Attention<T> &, Fused<const T *> d_out, Fused<T *> d_in, int64_t begin,
                        int64_t end, T *scratch, AttentionLayers<T *> sums);
template <class T>
T multiply_add(int64_t rounds, T factor, T addend);
template <class T>
int64_t ssim_scratch(const Ssim<T> &);
template <class T>
void ssim_map_rows(const Ssim<T> &, T *map, int64_t begin, int64_t end, T *scratch);
template <class T>
void ssim_sum_rows(const Ssim<T> &, SsimSums *, int64_t begin, int64_t end, T *scratch);
template <class T>
int64_t ssim_backward_scratch(const Ssim<T> &);
template <class T>
void ssim_backward_rows(const Ssim<T> &, const SsimGrads<T> &, int64_t begin, int64_t end, T *scratch);
template <class T>
ErrorSum squared_error_chunk(const SquaredError<T> &, int64_t begin, int64_t end);
template <class T>
void squared_error_chunk_backward(const SquaredError<T> &, T scale, T *d_a, int64_t begin, int64_t end);

template <class T>
void freeze(const Pass<T> &, int64_t tile, int64_t *counts, uint32_t *ids, T *weights);
template <class T>
void frozen_blend(const Grid &, int64_t block, int64_t count, const uint32_t *ids, const T *weights,
                  const T *values, int64_t channels, T *scratch, T *image);
template <class T>
void frozen_upstream(const Grid &, int64_t block, const T *d_image, int64_t channels, T *packs);
template <class T>
void frozen_backward(int64_t count, const uint32_t *entries, const uint32_t *blocks, const T *weights,
                     const T *upstream, int64_t channels, T *d_value);

extern const Kernels<Number> kKernels;

}  // namespace vlgs::VLGS_ISA_NS
