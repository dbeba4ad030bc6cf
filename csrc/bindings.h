// What the bindings of all operations share. Shapes that belong together are checked where the tensors come
// from (vlgs/ops); here arrays become pointers, the interpreter lock is released, and nothing is computed.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

namespace nb = nanobind;
using namespace nb::literals;

namespace vlgs {

// nanobind would copy an array of another dtype or stride, and what is written into a copy is lost: hence
// noconvert.
template <class T, nb::ssize_t... Shape>
using Array = nb::ndarray<T, nb::shape<Shape...>, nb::c_contig, nb::device::cpu>;
template <class T>
using Rows = Array<T, -1, -1>;
template <class T>
using Image = Array<T, -1, -1, -1>;

inline nb::arg strict(const char *name) {
  nb::arg arg(name);
  arg.noconvert();
  return arg;
}

// One file each, in float and double.
void bind_project(nb::module_ &m);
void bind_rasterize(nb::module_ &m);
void bind_attention(nb::module_ &m);
void bind_view_color(nb::module_ &m);
void bind_ssim(nb::module_ &m);
void bind_squared_error(nb::module_ &m);
void bind_cached_weights(nb::module_ &m);
void bind_code_table(nb::module_ &m);
void bind_learning(nb::module_ &m);

}  // namespace vlgs
