"""Pure functions of geometry: rotations, poses, lenses, targets, absolute orientation."""

from jaxvm.geometry.alignment import align as align
from jaxvm.geometry.alignment import nearest_rotation as nearest_rotation
from jaxvm.geometry.lenses import LENS_NAMES as LENS_NAMES
from jaxvm.geometry.lenses import BrownConrady as BrownConrady
from jaxvm.geometry.lenses import KannalaBrandt as KannalaBrandt
from jaxvm.geometry.lenses import LensFamily as LensFamily
from jaxvm.geometry.lenses import lens_family as lens_family
from jaxvm.geometry.lenses import project as project
from jaxvm.geometry.lenses import unproject as unproject
from jaxvm.geometry.poses import Pose as Pose
from jaxvm.geometry.poses import pose_from_vector as pose_from_vector
from jaxvm.geometry.poses import se3_adjoint as se3_adjoint
from jaxvm.geometry.poses import se3_exp as se3_exp
from jaxvm.geometry.poses import se3_log as se3_log
from jaxvm.geometry.poses import vector_from_pose as vector_from_pose
from jaxvm.geometry.rotations import hat as hat
from jaxvm.geometry.rotations import quaternion_from_rotation as quaternion_from_rotation
from jaxvm.geometry.rotations import rotation_from_quaternion as rotation_from_quaternion
from jaxvm.geometry.rotations import so3_exp as so3_exp
from jaxvm.geometry.rotations import so3_left_jacobian as so3_left_jacobian
from jaxvm.geometry.rotations import so3_left_jacobian_inverse as so3_left_jacobian_inverse
from jaxvm.geometry.rotations import so3_log as so3_log
from jaxvm.geometry.targets import grid_points as grid_points
