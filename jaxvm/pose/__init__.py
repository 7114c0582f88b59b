"""Poses from images: one camera, two cameras, and a laser range."""

from jaxvm.pose.monocular import Minimum as Minimum
from jaxvm.pose.monocular import Monocular as Monocular
from jaxvm.pose.monocular import locate as locate
from jaxvm.pose.monocular import orthogonal_iteration as orthogonal_iteration
from jaxvm.pose.orientation import orient as orient
from jaxvm.pose.precision import Precision as Precision
from jaxvm.pose.precision import Setup as Setup
from jaxvm.pose.precision import precision as precision
from jaxvm.pose.refine import Refined as Refined
from jaxvm.pose.refine import refine as refine
from jaxvm.pose.refine import refine_many as refine_many
from jaxvm.pose.sighting import Sighting as Sighting
from jaxvm.pose.sighting import sighting as sighting
from jaxvm.pose.station import Ranges as Ranges
from jaxvm.pose.station import locate_body as locate_body
from jaxvm.pose.station import locate_from_station as locate_from_station
from jaxvm.pose.triangulate import Triangulated as Triangulated
from jaxvm.pose.triangulate import linear as linear
from jaxvm.pose.triangulate import mid_point as mid_point
from jaxvm.pose.triangulate import optimal as optimal
