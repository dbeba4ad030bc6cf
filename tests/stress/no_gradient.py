"""Public functions that return floating tensors, found by themselves, and those among them that have no gradient to check."""

import importlib
import inspect
import pkgutil

AREAS = ("ops", "fields", "losses", "objectives", "geometry", "view_blend", "fusion", "gaussians", "heads", "queries", "indicator", "gsplat")  # fmt: skip
"""What a loss is made of. Scores (`metrics`), files (`data`, `formats`) and protocols have no gradient; `training` only adds these up, as most objectives do."""

NO_GRADIENT = {
    "vlgs.fusion.Fusion.__call__": "protocol",
    "vlgs.heads.Head.targets": "protocol",
    "vlgs.heads.Head.predict": "protocol",
    "vlgs.heads.Head.decode": "protocol",
    **{f"vlgs.objectives.{name}": "adds up the losses and renders that are checked" for name in (
        "objective.Objective.__call__", "photometric.Photometric.__call__", "language.Language.__call__",
        "blended_view.BlendedView.__call__", "blended_view.BlendedView.loss", "code_classes.CodeClasses.__call__",
        "codebook.CodebookLanguage.__call__", "lookup.LookupLanguage.__call__", "smooth_codes.SmoothCodes.__call__",
        "mask_classes.MaskClasses.__call__", "mask_classes.NeighbourClasses.__call__",
    )},
    "vlgs.objectives.smooth_codes.SmoothCodes.terms": "each term leaves one side where it is (tests/objectives)",
    "vlgs.objectives.mask_classes.NeighbourClasses.draw": "picks rows",
    "vlgs.objectives.targets.masked_codes": "picks pixels",
    "vlgs.objectives.targets.TrainingViews.codes_of": "picks rows of what is not trained",
    "vlgs.objectives.targets.covered": "a mask",
    "vlgs.objectives.objective.StepView.with_language": "goes through what is checked",
    "vlgs.gaussians.attributes.Attribute.first": "before training",
    "vlgs.gaussians.in_air.Air.__call__": "a mask",
    "vlgs.gaussians.init.in_view": "a mask",
    "vlgs.gaussians.parameters.at_levels": "before training",
    "vlgs.heads.clusters.clusters": "before training",
    "vlgs.heads.spread.spread_codes": "before training",
    "vlgs.heads.fitted_weights.read_weights": "reads a file",
    "vlgs.heads.rows.linear_gradients": "a gradient itself",
    "vlgs.heads.rows.for_error": "scales gradients",
    "vlgs.heads.lookup.LookupTable.decode": "picks rows, after training",
    "vlgs.heads.quantised.QuantisedCodes.targets": "picks rows",
    "vlgs.heads.quantised.quantise": "before training",
    "vlgs.gaussians.parameters.complete": "before training",
    "vlgs.gaussians.parameters.conform": "before training",
    "vlgs.queries.Query.relevancy": "protocol",
    "vlgs.queries.Query.__call__": "protocol",
    "vlgs.queries.text.TextEncoder.encode": "protocol",
    "vlgs.indicator.Indicator.__call__": "protocol",
    "vlgs.fusion.none.NoFusion.forward": "returns its arguments",
    "vlgs.indicator.Fixed.__call__": "a constant",
    "vlgs.gaussians.densify.DensifyState.mean": "a statistic",
    "vlgs.gaussians.background.with_background": "placed once",
    "vlgs.gaussians.init.initialise": "placed once",
    "vlgs.gaussians.init.parameters_of": "placed once",
    "vlgs.gaussians.init.distance_to_nearest": "of what is placed or pruned",
    "vlgs.gaussians.neighbors.mean_squared_distance": "placed once",
    "vlgs.gaussians.neighbors.nearest": "numbers of rows",
    "vlgs.gaussians.neighbors.pairs": "numbers of rows",
    "vlgs.gaussians.ply.read_ply": "from a file",
    "vlgs.gaussians.ply.parse_ply": "from a file",
    "vlgs.gaussians.validate.broken_rows": "a mask",
    "vlgs.gaussians.validate.drop_broken": "picks rows of a file",
    **{f"vlgs.fields.{name}": "protocol" for name in (
        "Field.similarity", "HasGaussians.opacities", "HasGaussians.language_weights",
        "HasGaussians.gaussian_similarity", "HasGaussians.render_values",
    )},
    "vlgs.fields.gaussians_of": "returns its argument",
    "vlgs.fields.saved.take_apart": "training is over",
    "vlgs.fields.planes.PlaneField.similarity": "training is over",
    **{f"vlgs.fields.planes.PlaneGaussians.{name}": "training is over" for name in (
        "opacities", "language_weights", "gaussian_similarity", "render_values",
    )},
    **{f"vlgs.queries.{query}.{name}": "training is over" for query in ("hyperplane.Hyperplane", "objects.Objects")
       for name in ("relevancy", "__call__")},
    "vlgs.queries.hyperplane.hinge_slope": "a gradient itself",
    **{f"vlgs.fields.trained.SplatField.{name}": "training is over" for name in (
        "similarity", "opacities", "language_weights", "gaussian_similarity", "render_values",
    )},
    **{f"vlgs.fields.{name}.objects": "a number of an object" for name in ("HasObjects", "trained.SplatField")},
    **{f"vlgs.queries.{name}": "a choice" for name in (
        "objects.choose_objects", "view_masks.MaskFolder.find", "view_masks.OwnMasks.find",
    )},
    "vlgs.fields.several.SeveralFields.similarity": "training is over",
    "vlgs.fields.splat.ViewRender.detach": "takes the gradient away",
    **{f"vlgs.fields.{name}": "training is over" for name in (
        "nerf.NerfField.similarity", "hash_splat.HashSplatField.similarity", "hash_splat.HashSplatField.opacities",
        "hash_splat.HashSplatField.language_weights", "hash_splat.HashSplatField.gaussian_similarity",
        "hash_splat.HashSplatField.render_values", "similarity.rendered_feature",
    )},
    **{f"vlgs.fields.{name}": "places, which nothing moves" for name in (
        "hash_grid.HashGrid.corners", "rays.Spacing.__call__", "rays.importance", "rays.nearest_seen", "radiance.nearest_of",
    )},
    "vlgs.ops.rasterize_to_pixels.weights_alone": "the constants of a CachedView",
    "vlgs.ops.depth.median_rows": "picks rows",
    "vlgs.ops.row_sums.row_sums_backward": "a gradient itself",
    "vlgs.ops.arrays.arrays": "hands over, computes nothing",
    **{f"vlgs.fields.comparing.{name}": "training is over" for name in (
        "Comparing.__call__", "Decoding.__call__", "Folding.__call__", "Folding.flat", "Tabulating.__call__",
    )},
    "vlgs.fields.similarity.unit_words": "words, which nothing moves",
    "vlgs.gsplat.example.draw": "goes through what is checked",
    "vlgs.gsplat.example.valid": "a mask",
    "vlgs.gsplat.view.ViewSplats.rows": "picks rows",
    "vlgs.gsplat.view.ViewSplats.detach": "takes the gradient away",
    "vlgs.gsplat.absgrad.watch": "hands on what it gets (tests/gsplat)",
    "vlgs.gsplat.absgrad.absolute_gradient": "a gradient itself",
    "vlgs.fields.HasDepth.depth": "protocol",
    **{f"vlgs.fields.{name}": "training is over" for name in (
        "depth_of", "trained.SplatField.depth", "hash_splat.HashSplatField.depth", "several.SeveralFields.depth",
        "planes.PlaneField.depth", "nerf.NerfField.depth",
    )},
    "vlgs.ops.cached_weights.Weights.render": "protocol",
    "vlgs.queries.text.VocabularyText.encode": "takes words",
    "vlgs.queries.text.ClipText.encode": "takes words",
}  # fmt: skip


def public_functions(package: str) -> set[str]:
    """Public functions and methods whose result holds floating tensors, by full name."""
    root = importlib.import_module(package)
    paths = getattr(root, "__path__", [])
    modules = [root.__name__, *(m.name for m in pkgutil.walk_packages(paths, package + "."))]
    found = set()
    for module in modules:
        for name, value in vars(importlib.import_module(module)).items():
            if name.startswith("_") or getattr(value, "__module__", None) != module:
                continue
            members = vars(value).items() if inspect.isclass(value) else [("", value)]
            for member, function in members:
                if member.startswith("_") and member != "__call__":
                    continue
                returns = str(getattr(function, "__annotations__", {}).get("return", ""))
                if inspect.isfunction(function) and any(
                    kind in returns
                    for kind in ("Float[", "Tensor", "Gaussians", "Render", "Splats")
                ):
                    found.add(f"{module}.{name}.{member}".rstrip("."))
    return found
