"""A world of cameras that knows nothing of the diagnosis it is made to test.

`record` draws a scene, hides effects in it and gives the recording and the truth. Everything is in
SI units and pixels; pixel (0, 0) is the centre of the top-left pixel; a camera looks along +z with
x right and y down. Sizes in `values` of the truth have these signs: a body's turn w and shift d
(camera or station, own axes) take a point x of that body's axes to exp(-w) (x - d); a target's turn
and shift are those of the target in the world; focal, scales and Brown's coefficients add.
"""

from .record import EFFECTS, KINDS, PLANS, Made, record

__all__ = ["EFFECTS", "KINDS", "PLANS", "Made", "record"]
