// The table of one instruction set, or of double.
#include "isa.h"

namespace vlgs::VLGS_ISA_NS {

#define VLGS_ENTRY(result, name, ...) name,
const Kernels<Number> kKernels = {VLGS_KERNELS(VLGS_ENTRY)};
#undef VLGS_ENTRY

}  // namespace vlgs::VLGS_ISA_NS
