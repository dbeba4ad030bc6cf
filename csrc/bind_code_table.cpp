// Answers from a table over code space.
#include "bindings.h"
#include "code_table.h"

namespace vlgs {
namespace {

template <class T>
void bind_code_table_of(nb::module_ &m) {
  m.def(
      "code_table",
      [](Array<const T, -1, 3> codes, double low, double per_unit, Array<const int32_t, -1, -1, -1> places,
         Rows<const T> rows, Rows<T> out, int threads) {
        const CodeTable<T> t{int64_t(codes.shape(0)),
                             int64_t(out.shape(0)),
                             codes.data(),
                             T(low),
                             T(per_unit),
                             int64_t(places.shape(0)),
                             places.data(),
                             int64_t(rows.shape(0)),
                             int64_t(rows.shape(1)),
                             rows.data(),
                             out.data()};
        nb::gil_scoped_release unlocked;
        return code_table<T>(t, threads);
      },
      strict("codes"), "low"_a, "per_unit"_a, strict("places"), strict("rows"), strict("out"), "threads"_a);
}

}  // namespace

void bind_code_table(nb::module_ &m) {
  bind_code_table_of<float>(m);
  bind_code_table_of<double>(m);
}

}  // namespace vlgs
