"""Things of glass and of metal, each built once at the origin, in metres.

Sizes are a little larger than life, so that a thing covers some thirty pixels of a default image.
"""

from vlgs.data.synthetic.materials import BLACK, BROWN, CLEAR, GREEN, glass, matte, mirror
from vlgs.data.synthetic.patterns import Plain, Wood
from vlgs.data.synthetic.shapes import Box, Torus, cone, cylinder, ellipsoid, sphere, turned
from vlgs.data.synthetic.things import TRANSLUCENT_REFLECTIVE, Material, Part, Thing, turn

_UPRIGHT_RING = turn("x", 90.0)


def _shiny(name: str, *parts: Part) -> Thing:
    return Thing(name, parts, TRANSLUCENT_REFLECTIVE)


def wine_glass() -> Thing:
    """Foot, stem and an open bowl."""
    bowl = turned((0.0, 0.09, 0.19), (0.022, 0.078, 0.062), closed_low=False, closed_high=False)
    return _shiny(
        "wine glass",
        Part(bowl, glass(), (0.0, 0.0, 0.14)),
        Part(cylinder(0.010, 0.12), glass(opacity=0.45), (0.0, 0.0, 0.02)),
        Part(cone(0.062, 0.012, 0.02), glass(opacity=0.35)),
    )


def glass_bottle() -> Thing:
    """A green bottle with a cork."""
    green = glass((0.25, 0.55, 0.36), 0.42)
    shoulder = turned(
        (0.0, 0.045, 0.09), (0.065, 0.048, 0.023), closed_low=False, closed_high=False
    )
    return _shiny(
        "glass bottle",
        Part(cylinder(0.065, 0.21, open_top=True), green),
        Part(shoulder, green, (0.0, 0.0, 0.21)),
        Part(cylinder(0.023, 0.07, open_top=True), green, (0.0, 0.0, 0.30)),
        Part(cylinder(0.021, 0.04), matte((0.70, 0.52, 0.32)), (0.0, 0.0, 0.355)),
    )


def glass_of_water() -> Thing:
    """A straight tumbler, two thirds full."""
    return _shiny(
        "glass of water",
        Part(cone(0.052, 0.066, 0.17, open_top=True), glass()),
        Part(cone(0.048, 0.057, 0.11), glass((0.55, 0.78, 0.88), 0.22), (0.0, 0.0, 0.008)),
    )


def glass_vase() -> Thing:
    """A waisted blue vase."""
    vase = turned((0.0, 0.11, 0.26), (0.062, 0.048, 0.09), closed_high=False)
    return _shiny("glass vase", Part(vase, glass((0.45, 0.62, 0.88), 0.34)))


def cookie_jar() -> Thing:
    """A clear jar with cookies in it and a wooden lid."""
    cookie = Material(Plain((0.72, 0.50, 0.27), grain=0.12, scale=0.03))
    cookies = [
        Part(cylinder(0.062, 0.024), cookie, (0.0, 0.0, 0.008 + 0.028 * i)) for i in range(4)
    ]
    return _shiny(
        "cookie jar",
        Part(cylinder(0.08, 0.17, open_top=True), glass()),
        Part(
            cylinder(0.086, 0.025),
            Material(Wood((0.72, 0.52, 0.32), BROWN, 0.04)),
            (0.0, 0.0, 0.17),
        ),
        Part(sphere(0.018), matte(BROWN), (0.0, 0.0, 0.21)),
        *cookies,
    )


def snow_globe() -> Thing:
    """A glass ball on a foot, with a small tree inside."""
    return _shiny(
        "snow globe",
        Part(sphere(0.085), glass((0.82, 0.90, 0.95), 0.14), (0.0, 0.0, 0.115)),
        Part(cone(0.075, 0.058, 0.05), matte((0.35, 0.16, 0.14), 0.2)),
        Part(cone(0.042, 0.002, 0.09), matte(GREEN), (0.0, 0.0, 0.05)),
    )


def steel_kettle() -> Thing:
    """A round kettle with spout, lid and a black handle over the top."""
    body = turned((0.0, 0.06, 0.14), (0.09, 0.108, 0.06))
    return _shiny(
        "steel kettle",
        Part(body, mirror()),
        Part(ellipsoid(0.06, 0.025), mirror(), (0.0, 0.0, 0.14)),
        Part(sphere(0.016), matte(BLACK, 0.3), (0.0, 0.0, 0.178)),
        Part(cone(0.026, 0.014, 0.10), mirror(), (0.075, 0.0, 0.06), turn("y", 48.0)),
        Part(Torus(0.085, 0.011), matte(BLACK, 0.3), (0.0, 0.0, 0.135), _UPRIGHT_RING),
    )


def chrome_ball() -> Thing:
    """A garden ball: the whole room is in it."""
    return _shiny("chrome ball", Part(sphere(0.09), mirror(reflectance=0.88), (0.0, 0.0, 0.09)))


def vanity_mirror() -> Thing:
    """A flat mirror in a wooden frame, leaning back a little."""
    lean = turn("x", -10.0)
    return _shiny(
        "vanity mirror",
        Part(Box((0.105, 0.002, 0.135)), mirror(CLEAR, 0.86), (0.0, -0.013, 0.165), lean),
        Part(
            Box((0.125, 0.012, 0.155)),
            Material(Wood(BROWN, BLACK, 0.08)),
            (0.0, 0.002, 0.165),
            lean,
        ),
        Part(Box((0.10, 0.06, 0.010)), Material(Wood(BROWN, BLACK, 0.08)), (0.0, 0.02, 0.010)),
    )


def silver_vase() -> Thing:
    """A tall waisted vase."""
    vase = turned((0.0, 0.12, 0.30), (0.075, 0.040, 0.072))
    return _shiny("silver vase", Part(vase, mirror((0.86, 0.84, 0.80))))


def toaster() -> Thing:
    """A steel box with two slots and a lever."""
    return _shiny(
        "toaster",
        Part(Box((0.12, 0.07, 0.075)), mirror(reflectance=0.7), (0.0, 0.0, 0.087)),
        Part(Box((0.09, 0.010, 0.003)), matte(BLACK), (0.0, 0.025, 0.163)),
        Part(Box((0.09, 0.010, 0.003)), matte(BLACK), (0.0, -0.025, 0.163)),
        Part(Box((0.125, 0.075, 0.007)), matte(BLACK, 0.2), (0.0, 0.0, 0.007)),
        Part(Box((0.012, 0.02, 0.008)), matte(BLACK, 0.2), (0.13, 0.0, 0.12)),
    )


def steel_pot() -> Thing:
    """A cooking pot with a lid and two black handles."""
    return _shiny(
        "steel pot",
        Part(cylinder(0.10, 0.12), mirror(reflectance=0.7)),
        Part(ellipsoid(0.102, 0.03), mirror(reflectance=0.7), (0.0, 0.0, 0.12)),
        Part(sphere(0.018), matte(BLACK, 0.3), (0.0, 0.0, 0.162)),
        Part(Torus(0.028, 0.008), matte(BLACK, 0.3), (0.11, 0.0, 0.09)),
        Part(Torus(0.028, 0.008), matte(BLACK, 0.3), (-0.11, 0.0, 0.09)),
    )
