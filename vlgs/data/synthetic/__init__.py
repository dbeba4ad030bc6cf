"""Procedural scenes: the default data of vlgs, made from nothing in seconds.

How a scene is made. Everyday things (`props.yaml`) stand on a round table (`scenes/*.yaml`, or a file of the user: `scene_file`) in a lit
room (`room`, `layouts`). An analytic ray tracer (`tracer`) photographs them from a walk around the table (`cameras`), with a class for every pixel that
is exact at the pixel's centre. Sparse points are drawn on what the training views see (`points`). Language supervision is the exact
segmentation, spoilt as SAM and CLIP spoil it, at known rates, independently in every view and alike at all levels (`masks`), with vectors that
have the geometry of CLIP's (`language`).

What each scene tests.

* ``glassware``: translucent things. Colour behind glass is that of what lies behind, language is that of the glass: the
  claim behind the semantic indicator (Eq. 6).
* ``mirrors``: steel and mirrors. Colour moves with the viewer and glare moves with the lamp, language stays.
* ``lookalikes``: eight different things of one red. Colour does not tell classes apart.
* ``patchwork``: things of many colours each. Colour tells apart what is one.
* ``wirework``: things of wire, one to four pixels wide. Most of what a pixel shows lies behind what it is of.
* ``rows``: the same thing several times, and others of nearly its shape and colour between.
* ``smallware``: things of a dozen pixels. Most of every picture is surroundings.
* ``sunroom``: low light from a window at one side. Soft shadows of things lie across other things, so that one thing has two brightnesses
  and an edge where there is none; and training photographs are unequally exposed, held-out ones are not (`photographs.exposures`).
  ``sunroom_even`` is the same, photographed at one exposure.

The first four also come seen from elsewhere, as scenes of their own (`outdoors`): ``glassware_ring`` in the room, from a ring around the table;
``glassware_sky`` from such a ring under a sky that has neither points nor masks; ``glassware_wall`` from an arc before a plain wall without
points. Half of their held-out views lie between training views, a quarter beyond them and a quarter above.

The ablation tables use ``difficulty=hard`` with ``trainer=benchmark``: there the model without the paper's three ideas (``fusion=none
indicator=opacity blend=none``) scores an mIoU of 0.62 to 0.74, which leaves room in both directions; on ``easy`` it scores 0.87 to 0.89
with 700 iterations, and rows can hardly differ.

``hard`` adds things, so that they hide each other and some come twice, and about doubles the faults. Every pixel has a class;
table, wall and floor are classes too, but only what stands on the table is asked for in object labels. Categories are
``translucent_reflective`` or ``other``. Read as a segmentation, the whole-object supervision of the training views has an
mIoU of 0.70 to 0.74 (easy) and 0.47 to 0.54 (hard) against the truth: a model that scores higher has won it from
the agreement of views.

What the scenes do not show. Glass does not refract; light is one lamp without interreflection; but for ``sunroom``, shadows fall on
table and floor only and all photographs are equally exposed; there is no lens, no motion blur, no pose error. Textures are smooth and shapes are
quadrics, boxes and rings. Words have no synonyms and images no context: vectors know the class, a piece's own drift, an
offset and noise. Fault rates are round numbers, not measurements of SAM or CLIP. A method that wins here has passed a test of
mechanism; numbers compare with each other and with nothing that was measured on photographs.
"""

from vlgs.data.synthetic.masks import NO_NOISE, LabelNoise, LevelMasks
from vlgs.data.synthetic.scene import language_levels, load_scene
from vlgs.data.synthetic.settings import SceneSettings

__all__ = ["NO_NOISE", "LabelNoise", "LevelMasks", "SceneSettings", "language_levels", "load_scene"]
