"""Language from a blended camera: the third term of Eq. 12, with Eqs. 9 to 11."""

from typing import ClassVar

from jaxtyping import Float
from torch import Tensor

from vlgs.objectives.between import BlendPlan, CamerasBetween, plan_blend
from vlgs.objectives.language import MOST, Language
from vlgs.objectives.objective import Objective, Setup, StepView
from vlgs.objectives.targets import Target
from vlgs.values import require_range
from vlgs.view_blend import blend_targets


class BlendedView(Objective):
    """``lambda L_b``: a camera between the two real views should see a mix of their codes, judged as `Language` judges the real ones.

    Args:
        weight: lambda of Eq. 12; the weight of the run's `Language` multiplies it.

    Raises:
        ValueError: If the weight is negative or not finite.
    """

    needs = frozenset({"feature"})
    blends: ClassVar[bool] = True
    """It looks at blended views."""

    def __init__(self, weight: float = 1.2) -> None:
        require_range("blended view", 0, MOST, weight=weight)
        self.weight = weight
        self.language = Language()

    def bind(self, setup: Setup) -> None:
        """Cameras between those of the scene; the error is that of the run's `Language`."""
        self.setup = setup
        views = setup.views
        cameras = [view.camera for view in views.scene.train]
        self.between = CamerasBetween(views.sampler, cameras, setup.blend)
        for objective in setup.objectives.values():
            if isinstance(objective, Language):
                self.language = objective
        self.language.bind(setup)

    def __call__(self, step: StepView) -> dict[str, Float[Tensor, ""]]:
        """One term, where there is a blended view and its weight counts."""
        plan = self.plan(step.step, step.pair, step.targets)
        if plan is None:
            return {}
        step.log["blend_weight"] = plan.weight
        return {"blended": self.loss(plan, step)}

    def plan(
        self, step: int, pair: tuple[int, int], targets: tuple[Target, Target]
    ) -> BlendPlan | None:
        """The blended view of an iteration; None where there is none or its loss does not count."""
        (first, second), setup = targets, self.setup
        if (
            pair[0] == pair[1]
            or not setup.blend.active
            or not (first.has_language and second.has_language)
        ):
            return None
        similarity = setup.views.similarity(*pair) if setup.blend.ssim else 1.0
        weight = self.language.weight * self.weight * similarity
        if weight <= setup.blend_least:
            setup.counts.skip("blend_zero" if weight <= 0 else "blend_small")
            return None
        k, between = self.between.at(step)
        cameras = (first.view.camera, second.view.camera)
        return plan_blend(cameras, k, between, similarity, weight, setup.blend, setup.blend_reuse)

    def loss(self, plan: BlendPlan, step: StepView) -> Float[Tensor, ""]:
        """What the blended view adds to Eq. 12."""
        (first, second), counts = step.targets, self.setup.counts
        codes, valid = blend_targets(
            first.codes, first.valid, second.codes, second.valid, plan.k, self.setup.blend
        )
        if plan.reuse is not None:
            counts.skip("blend_reuse")
            feature = step.renders[plan.reuse].feature
        else:
            with counts.doing("blended render"):
                feature = step.render(plan.camera, color=False).feature
        assert feature is not None
        return plan.weight * self.language.of(feature, codes, valid)
