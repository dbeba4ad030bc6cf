// The table of one instruction set.
#include "isa.h"

namespace vlgs::VLGS_ISA_NS {

const Kernels<float> kFloat = {project,
                               project_backward,
                               boxes,
                               cover,
                               blend_scratch,
                               backward_scratch,
                               blend,
                               blend_backward,
                               freeze,
                               frozen_blend,
                               frozen_upstream,
                               frozen_backward,
                               attention_scratch<float>,
                               attention,
                               attention_backward,
                               multiply_add,
                               filter_plane};
const Kernels<double> kDouble = {project,
                                 project_backward,
                                 boxes,
                                 cover,
                                 blend_scratch,
                                 backward_scratch,
                                 blend,
                                 blend_backward,
                                 freeze,
                                 frozen_blend,
                                 frozen_upstream,
                                 frozen_backward,
                                 attention_scratch<double>,
                                 attention,
                                 attention_backward,
                                 multiply_add,
                                 filter_plane};

}  // namespace vlgs::VLGS_ISA_NS
