"""Trained scenes taken apart into JSON and tensors, and put together again without the data that they learned from.

A plan says what a field consists of. Networks that a configuration chooses (fusion, indicator, head) stand in it by the name of their class:
whoever puts the field together has the configuration, and makes them.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, fields, is_dataclass
from functools import partial
from typing import Any, TypeVar, get_args, get_type_hints

import torch
from torch import Tensor, nn

from vlgs.fields import Field
from vlgs.fields.hash_splat import HashSplatField
from vlgs.fields.language_field import LanguageConfig, LanguageField
from vlgs.fields.nerf import NerfField
from vlgs.fields.planes import Plane, PlaneField, with_planes
from vlgs.fields.radiance import Frame, RadianceConfig, RadianceField
from vlgs.fields.rays import Spacing
from vlgs.fields.several import SeveralFields
from vlgs.fields.splat import SplatModel
from vlgs.fields.trained import ObjectField, SplatField
from vlgs.gaussians.attributes import Attribute
from vlgs.gaussians.validate import require_sound
from vlgs.ops.rasterize import check_config
from vlgs.types import RasterConfig
from vlgs.values import require_types

Plan = Mapping[str, Any]
"""JSON values."""
Tensors = Mapping[str, Tensor]
MakePart = Callable[[str, str], Any]
"""Takes a group of the configuration and the path of a class."""

T = TypeVar("T")
_WHO = "field"
_SMALL = 1 << 20
"""Numbers that may be made before it is known whether they are there."""
_CHOSEN = ("fusion", "indicator", "head")
"""Parts of a model that the configuration makes."""


def take_apart(field: Field) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """A plan of a field and its tensors.

    Raises:
        ValueError: If it is of a kind that is not known here, such as one of a user's own.
    """
    for kind, (of, apart, _) in _KINDS.items():
        if isinstance(field, of):
            plan, tensors = apart(field)
            return {"kind": kind, **plan}, {k: v.detach() for k, v in tensors.items()}
    raise ValueError(f"{_WHO}: it must be of a kind that can be kept, got {_path(field)}")


def plan_of_model(model: SplatModel, color: bool, language: bool) -> dict[str, Any]:
    """The plan of Gaussians whose tensors are those of `model.state_dict`; see `vlgs.fields.trained.SplatField`."""
    return {
        "kind": "splats",
        "color": color,
        "language": language,
        "level": None,
        "sh_degree": model.sh_degree,
        "evaluated": model.evaluated,
        "raster": asdict(model.raster),
        "attributes": [asdict(row) for row in model.attributes.values()],
        **{name: _path(getattr(model, name)) for name in _CHOSEN},
    }


@torch.no_grad()
def put_together(plan: Plan, tensors: Tensors, make: MakePart) -> Field:
    """The field of a plan.

    Args:
        plan: From `take_apart`, possibly read from a file that nobody vouches for.
        tensors: Likewise.
        make: Makes a fusion, an indicator or a head.

    Raises:
        ValueError: If plan and tensors do not make a field; names what is missing or does not fit.
    """
    if not isinstance(plan, Mapping) or plan.get("kind") not in _KINDS:
        got = plan.get("kind") if isinstance(plan, Mapping) else type(plan).__name__
        raise ValueError(f"{_WHO}: kind must be one of {', '.join(_KINDS)}, got {got!r:.80}")
    try:
        return _KINDS[plan["kind"]][2](plan, tensors, make)
    except KeyError as error:
        raise ValueError(f"{_WHO}: {plan['kind']} must have {error}, got none") from error
    except (TypeError, AttributeError) as error:
        raise ValueError(f"{_WHO}: {plan['kind']} must be made of its parts: {error}") from error


def _splats_apart(field: SplatField) -> tuple[dict[str, Any], dict[str, Tensor]]:
    plan = plan_of_model(field.model, field.color, field.has_language) | {"level": field.level}
    return plan, dict(field.model.state_dict())


def _splats_together(plan: Plan, tensors: Tensors, make: MakePart) -> SplatField:
    attributes = {row.name: row for row in (rebuild(Attribute, one) for one in plan["attributes"])}
    raw = _below(tensors, "splats")
    _require_rows(raw, attributes)
    raster = rebuild(RasterConfig, plan["raster"])
    check_config(raster)
    indicator = make("indicator", plan["indicator"])
    fusion, head = (
        _sized(partial(make, group, plan[group]), _below(tensors, group))
        for group in ("fusion", "head")
    )
    degree = plan["sh_degree"]
    if degree not in range(4) or (degree + 1) ** 2 - 1 > raw["shN"].shape[1]:
        raise ValueError(f"{_WHO}: sh_degree must be one that shN has, got {degree!r:.80}")
    model = SplatModel(
        raw, fusion, indicator, head, raster, degree, bool(plan["evaluated"]), attributes
    )
    _load(model, {k: v for k, v in tensors.items() if k.partition(".")[0] in ("splats", *_CHOSEN)})
    if plan["language"] and model.splats["features"].shape[1] % head.dim:
        raise ValueError(
            f"{_WHO}: features must be as wide as codes of {head.dim}, or several of them, got {model.splats['features'].shape[1]}"
        )
    return SplatField(model, bool(plan["color"]), plan["level"], bool(plan["language"]))


def _objects_apart(field: ObjectField) -> tuple[dict[str, Any], dict[str, Tensor]]:
    plan, tensors = _splats_apart(field)
    objects = {"objects.words": field.words, "objects.chosen": field.chosen}
    return plan | {"kind": "objects"}, tensors | objects


def _objects_together(plan: Plan, tensors: Tensors, make: MakePart) -> ObjectField:
    words, chosen = tensors["objects.words"], tensors["objects.chosen"]
    return _splats_together(plan, tensors, make).with_objects(words, chosen.bool())


def _several_apart(field: SeveralFields) -> tuple[dict[str, Any], dict[str, Tensor]]:
    plans, tensors = [], dict[str, Tensor]()
    for index, one in enumerate(field.fields):
        plan, own = take_apart(one)
        plans.append(plan)
        tensors |= _above(own, str(index))
    return {"fields": plans}, tensors


def _several_together(plan: Plan, tensors: Tensors, make: MakePart) -> SeveralFields:
    parts = enumerate(plan["fields"])
    return SeveralFields([put_together(p, _below(tensors, str(i)), make) for i, p in parts])


def _planes_apart(field: PlaneField) -> tuple[dict[str, Any], dict[str, Tensor]]:
    plan, tensors = take_apart(field.field)
    weights = [plane.weights for plane in field.planes]
    planes = {"words": field.words, "weights": torch.stack(weights)}
    return (
        {"field": plan, "bias": [plane.bias for plane in field.planes]},
        {**_above(tensors, "field"), **planes},
    )


def _planes_together(plan: Plan, tensors: Tensors, make: MakePart) -> Field:
    inner = put_together(plan["field"], _below(tensors, "field"), make)
    words, weights, bias = tensors["words"], tensors["weights"], plan["bias"]
    if words.dim() != 2 or weights.shape != words.shape or len(bias) != len(words):
        raise ValueError(f"{_WHO}: planes must be one for each word, got {list(weights.shape)}")
    planes = [Plane(row, float(b)) for row, b in zip(weights, bias, strict=True)]
    return with_planes(inner, words, planes)


def _radiance_apart(field: NerfField) -> tuple[dict[str, Any], dict[str, Tensor]]:
    frame, plan = _frame_apart(field.radiance.frame)
    plan |= {"radiance": asdict(field.radiance.config), "samples": field.samples}
    plan |= {"scales": [one for one in field.scales if one is not None]}
    tensors = frame | _above(field.radiance.state_dict(), "radiance")
    if field.language is not None:
        own, weights = _language_apart(field.language)
        plan, tensors = plan | own, tensors | weights
    if field.negatives is not None:
        tensors["negatives"] = field.negatives
    return plan, tensors


def _radiance_together(plan: Plan, tensors: Tensors, make: MakePart) -> NerfField:
    config, frame = rebuild(RadianceConfig, plan["radiance"]), _frame_together(plan, tensors)
    weights = _below(tensors, "radiance")
    radiance = _sized(partial(RadianceField, config, frame), weights)
    _load(radiance, weights)
    language = _language_together(plan, tensors) if "language" in plan else None
    require_types(_WHO, {"samples": int}, {"samples": plan["samples"]})
    scales = [float(one) for one in plan["scales"]]
    return NerfField(radiance, language, plan["samples"], scales, tensors.get("negatives"))


def _hash_apart(field: HashSplatField) -> tuple[dict[str, Any], dict[str, Tensor]]:
    plan, tensors = take_apart(field.splats)
    frame, own = _frame_apart(field.frame)
    language, weights = _language_apart(field.language)
    return {"splats": plan} | own | language, _above(tensors, "splats") | frame | weights


def _hash_together(plan: Plan, tensors: Tensors, make: MakePart) -> HashSplatField:
    splats = put_together(plan["splats"], _below(tensors, "splats"), make)
    if not isinstance(splats, SplatField):
        raise ValueError(f"{_WHO}: splats must be Gaussians, got {_path(splats)}")
    language = _language_together(plan, tensors)
    return HashSplatField(splats, language, _frame_together(plan, tensors))


def _language_apart(language: LanguageField) -> tuple[dict[str, Any], dict[str, Tensor]]:
    widths = {"embedding": _width(language.head), "second": _width(language.second)}
    plan = {"language": asdict(language.config), **widths}
    return plan, _above(language.state_dict(), "language")


def _language_together(plan: Plan, tensors: Tensors) -> LanguageField:
    config = rebuild(LanguageConfig, plan["language"])
    widths = {name: plan[name] for name in ("embedding", "second")}
    require_types(_WHO, dict.fromkeys(widths, int), widths)
    weights = _below(tensors, "language")
    language = _sized(partial(LanguageField, config, **widths), weights)
    _load(language, weights)
    return language


def _frame_apart(frame: Frame) -> tuple[dict[str, Tensor], dict[str, Any]]:
    tensors = {"frame.center": frame.center, "frame.points": frame.points}
    return tensors, {"scale": frame.scale, "spacing": asdict(frame.spacing)}


def _frame_together(plan: Plan, tensors: Tensors) -> Frame:
    require_types(_WHO, {"scale": float}, {"scale": plan["scale"]})
    spacing = rebuild(Spacing, plan["spacing"])
    return Frame(tensors["frame.center"], plan["scale"], spacing, tensors["frame.points"])


_KINDS: Mapping[str, tuple[type, Callable[..., Any], Callable[..., Field]]] = {
    "objects": (ObjectField, _objects_apart, _objects_together),  # which is a field of splats, too
    "splats": (SplatField, _splats_apart, _splats_together),
    "several": (SeveralFields, _several_apart, _several_together),
    "planes": (PlaneField, _planes_apart, _planes_together),
    "radiance": (NerfField, _radiance_apart, _radiance_together),
    "hash_splats": (HashSplatField, _hash_apart, _hash_together),
}
"""Kind of a field -> its class, how it is taken apart, and how it is put together."""


def rebuild(kind: type[T], plain: Any) -> T:
    """A dataclass from what `dataclasses.asdict` made of it and JSON kept.

    Raises:
        ValueError: If a value has another type, or there is one that it does not have.

    Example:
        >>> rebuild(Spacing, {"near": 0.1, "far": 2.0}).share
        0.75
    """
    if not isinstance(plain, Mapping):
        raise ValueError(f"{_WHO}: {kind.__name__} must be a mapping, got {plain!r:.80}")
    assert is_dataclass(kind)
    hints = get_type_hints(kind)
    known = [one.name for one in fields(kind)]
    odd = sorted(set(plain) - set(known))
    if odd:
        raise ValueError(f"{_WHO}: {kind.__name__} must not have {odd[0]!r:.80}")
    values = {name: _rebuilt(hints[name], plain[name]) for name in known if name in plain}
    require_types(kind.__name__, hints, values)
    return kind(**values)


def _rebuilt(hint: Any, value: Any) -> Any:
    if is_dataclass(hint) and isinstance(hint, type):
        return rebuild(hint, value)
    inner = next((a for a in get_args(hint) if is_dataclass(a) and isinstance(a, type)), None)
    if isinstance(value, list):
        return tuple(rebuild(inner, one) if inner else _rebuilt(Any, one) for one in value)
    return value


def _require_rows(raw: Tensors, attributes: Mapping[str, Attribute]) -> None:
    """Refuse Gaussians that are not those of the table."""
    odd = sorted(set(raw) ^ set(attributes))
    if odd:
        raise ValueError(
            f"{_WHO}: attributes must be those of the table, got another {odd[0]!r:.80}"
        )
    count = len(raw["means"]) if raw["means"].dim() else 0
    for name, value in raw.items():
        shape = attributes[name].shape
        fits = value.dim() > 0 and len(value) == count and value.is_floating_point()
        if not fits or (shape is not None and tuple(value.shape[1:]) != tuple(shape)):
            wanted = [count, *(shape or ["..."])]
            raise ValueError(f"{_WHO}: {name} must be {wanted}, got {list(value.shape)}")
    require_sound(_WHO, raw)


def _sized(build: Callable[[], T], tensors: Tensors) -> T:
    """What weights belong to, unless it is larger than they are: a plan may not ask for memory that its tensors do not fill.

    It is first built on a device that holds nothing.
    """
    with torch.device("meta"):
        made = build()
    for name, value in made.state_dict().items() if isinstance(made, nn.Module) else ():
        got = tensors.get(name)
        if value.numel() > _SMALL and (got is None or got.shape != value.shape):
            size = "none" if got is None else list(got.shape)
            raise ValueError(f"{_WHO}: weights {name} must be {list(value.shape)}, got {size}")
    return build()


def _load(module: nn.Module, tensors: Tensors) -> None:
    try:
        module.load_state_dict(dict(tensors))
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{_WHO}: weights must fit what they belong to: {reason:.300}") from error
    module.requires_grad_(False)


def _width(network: nn.Sequential | None) -> int:
    """Outputs of a network; 0 without one."""
    last = None if network is None else network[-1]
    return last.out_features if isinstance(last, nn.Linear) else 0


def _below(tensors: Tensors, name: str) -> dict[str, Tensor]:
    prefix = f"{name}."
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def _above(tensors: Tensors, name: str) -> dict[str, Tensor]:
    return {f"{name}.{key}": value for key, value in tensors.items()}


def _path(made: object) -> str:
    return f"{type(made).__module__}.{type(made).__qualname__}"
