// What trains networks: RAdam's steps, the gradient of a hash grid's table, errors of mapped codes and of
// neighbours.
#include <nanobind/stl/optional.h>

#include <optional>

#include "bindings.h"
#include "huber.h"
#include "mapped_error.h"
#include "neighbours.h"
#include "radam.h"
#include "row_sums.h"

namespace vlgs {
namespace {

template <class T>
void bind_learning_of(nb::module_ &m) {
  using Numbers = Array<T, -1>;
  m.def(
      "radam_moments",
      [](Array<const T, -1> weight, Array<const T, -1> gradient, Numbers mean, Numbers square, double decay,
         double to_mean, double kept, double to_square, int threads) {
        const RAdamMoments<T> r{int64_t(weight.shape(0)),
                                weight.data(),
                                gradient.data(),
                                mean.data(),
                                square.data(),
                                T(decay),
                                T(to_mean),
                                T(kept),
                                T(to_square)};
        nb::gil_scoped_release unlocked;
        radam_moments<T>(r, threads);
      },
      strict("weight"), strict("gradient"), strict("mean"), strict("square"), "decay"_a, "to_mean"_a,
      "kept"_a, "to_square"_a, "threads"_a);
  m.def(
      "radam_weights",
      [](Array<const T, -1> mean, std::optional<Array<const T, -1>> root, Numbers weight, double bias,
         double rate, double eps, double scale, double rectified, int threads) {
        const RAdamWeights<T> r{int64_t(mean.shape(0)),
                                mean.data(),
                                root ? root->data() : nullptr,
                                weight.data(),
                                T(bias),
                                T(rate),
                                T(eps),
                                T(scale),
                                T(rectified)};
        nb::gil_scoped_release unlocked;
        radam_weights<T>(r, threads);
      },
      strict("mean"), strict("root").none(), strict("weight"), "bias"_a, "rate"_a, "eps"_a, "scale"_a,
      "rectified"_a, "threads"_a);
  m.def(
      "mapped_error",
      [](Rows<T> made, Array<const T, -1> bias, Rows<const T> wanted, Array<const int64_t, -1> which,
         double scale, int threads) {
        const MappedError<T> e{int64_t(which.shape(0)), int64_t(made.shape(1)), made.data(), bias.data(),
                               wanted.data(),           which.data(),           T(scale)};
        nb::gil_scoped_release unlocked;
        return mapped_error<T>(e, threads);
      },
      strict("made"), strict("bias"), strict("wanted"), strict("which"), "scale"_a, "threads"_a);
  m.def(
      "huber",
      [](nb::ndarray<const T, nb::shape<-1, -1, -1>, nb::device::cpu> image, Image<const T> target,
         Array<const bool, -1, -1> valid, double delta, Image<T> clamped, int threads) {
        const Huber<T> h{int64_t(target.shape(0)),
                         int64_t(target.shape(1)),
                         int64_t(target.shape(2)),
                         image.stride(0),
                         image.stride(1),
                         image.data(),
                         target.data(),
                         valid.data(),
                         T(delta),
                         clamped.data()};
        nb::gil_scoped_release unlocked;
        return huber<T>(h, threads);
      },
      strict("image"), strict("target"), strict("valid"), "delta"_a, strict("clamped"), "threads"_a);
  m.def(
      "neighbours_backward",
      [](Image<const T> image, Image<const T> d_products, Image<T> d_image, int threads) {
        const Neighbours<T> n{int64_t(image.shape(0)), int64_t(image.shape(1)),
                              int64_t(image.shape(2)), image.data(),
                              d_products.data(),       d_image.data()};
        nb::gil_scoped_release unlocked;
        neighbours_backward<T>(n, threads);
      },
      strict("image"), strict("d_products"), strict("d_image"), "threads"_a);
  m.def(
      "row_sums_backward",
      // Of T first: the wrong one of two functions uses up capsules until it comes to one that it cannot
      // take.
      [](Array<const T, -1, kCorners> weights, Array<const int32_t, -1, kCorners> rows,
         Array<const int64_t, -1> begins, Array<const T, -1, -1, -1> d_sums, Rows<T> d_table, int threads) {
        const RowSums<T> s{int64_t(begins.shape(0)),
                           int64_t(d_sums.shape(0)),
                           int64_t(d_sums.shape(2)),
                           int64_t(d_table.shape(0)),
                           begins.data(),
                           rows.data(),
                           weights.data(),
                           d_sums.data(),
                           d_table.data()};
        nb::gil_scoped_release unlocked;
        return row_sums_backward<T>(s, threads);
      },
      strict("weights"), strict("rows"), strict("begins"), strict("d_sums"), strict("d_table"), "threads"_a);
}

}  // namespace

void bind_learning(nb::module_ &m) {
  bind_learning_of<float>(m);
  bind_learning_of<double>(m);
}

}  // namespace vlgs
