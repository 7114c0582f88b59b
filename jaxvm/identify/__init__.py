"""Cameras and temperature: drift models, couplings, identification, compensation."""

from jaxvm.identify.compensate import compensate as compensate
from jaxvm.identify.identify import Identification as Identification
from jaxvm.identify.identify import identify as identify
from jaxvm.identify.model import DriftModel as DriftModel
from jaxvm.identify.model import read_drift_model as read_drift_model
from jaxvm.identify.stream import Compensator as Compensator
