// The table of one instruction set.
#include "isa.h"

namespace vlgs::VLGS_ISA_NS {

const Kernels<float> kFloat = {project,        project_backward, cover,  blend_scratch, backward_scratch,
                               blend,          blend_backward,   freeze, frozen_blend,  frozen_upstream,
                               frozen_backward};
const Kernels<double> kDouble = {project,        project_backward, cover,  blend_scratch, backward_scratch,
                                 blend,          blend_backward,   freeze, frozen_blend,  frozen_upstream,
                                 frozen_backward};

}  // namespace vlgs::VLGS_ISA_NS
