// Similarity of two images as a map or as sums, and back.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/tuple.h>

#include <optional>

#include "bindings.h"
#include "ssim.h"

namespace vlgs {
namespace {

template <class T>
void bind_ssim_of(nb::module_ &m) {
  using Valid = std::optional<Array<const bool, -1, -1>>;
  using Taps = Array<const T, kTaps>;
  using Floors = std::pair<double, double>;
  const auto make = [](const Image<const T> &a, const Image<const T> &b, const Valid &valid, const Taps &taps,
                       const Floors &floors) {
    return Ssim<T>{int64_t(a.shape(0)),
                   int64_t(a.shape(1)),
                   int64_t(a.shape(2)),
                   a.data(),
                   b.data(),
                   valid ? valid->data() : nullptr,
                   taps.data(),
                   T(floors.first),
                   T(floors.second)};
  };
  m.def(
      "ssim_map",
      [make](Image<const T> a, Image<const T> b, Taps taps, Floors floors, Image<T> map, int threads) {
        const auto s = make(a, b, {}, taps, floors);
        nb::gil_scoped_release unlocked;
        ssim_map<T>(s, map.data(), threads);
      },
      strict("a"), strict("b"), strict("taps"), "floors"_a, strict("map"), "threads"_a);
  m.def(
      "ssim_sums",
      [make](Image<const T> a, Image<const T> b, Valid valid, Taps taps, Floors floors, int threads) {
        const auto s = make(a, b, valid, taps, floors);
        nb::gil_scoped_release unlocked;
        const SsimSums total = ssim_sums<T>(s, threads);
        return std::tuple(total.distance, total.dissimilarity, total.pixels);
      },
      strict("a"), strict("b"), strict("valid").none(), strict("taps"), "floors"_a, "threads"_a);
  const auto backward = [](const Ssim<T> &s, const SsimGrads<T> &d, int threads) {
    nb::gil_scoped_release unlocked;
    ssim_backward<T>(s, d, threads);
  };
  m.def(
      "ssim_map_backward",
      [make, backward](Image<const T> a, Image<const T> b, Taps taps, Floors floors, Image<const T> d_map,
                       Image<T> d_a, std::optional<Image<T>> d_b, int threads) {
        backward(make(a, b, {}, taps, floors), {d_map.data(), 0, 0, d_a.data(), d_b ? d_b->data() : nullptr},
                 threads);
      },
      strict("a"), strict("b"), strict("taps"), "floors"_a, strict("d_map"), strict("d_a"),
      strict("d_b").none(), "threads"_a);
  m.def(
      "ssim_sums_backward",
      [make, backward](Image<const T> a, Image<const T> b, Valid valid, Taps taps, Floors floors,
                       double d_distance, double d_dissimilarity, Image<T> d_a, std::optional<Image<T>> d_b,
                       int threads) {
        backward(make(a, b, valid, taps, floors),
                 {nullptr, T(-d_dissimilarity), T(d_distance), d_a.data(), d_b ? d_b->data() : nullptr},
                 threads);
      },
      strict("a"), strict("b"), strict("valid").none(), strict("taps"), "floors"_a, "d_distance"_a,
      "d_dissimilarity"_a, strict("d_a"), strict("d_b").none(), "threads"_a);
}

}  // namespace

void bind_ssim(nb::module_ &m) {
  bind_ssim_of<float>(m);
  bind_ssim_of<double>(m);
}

}  // namespace vlgs
