"""The sensor at the whisker's base: what it reads, how it is mounted, how to calibrate it."""

from vibrissa.sensing.contacts import calibrate_on_contacts
from vibrissa.sensing.files import load_sensor, save_sensor
from vibrissa.sensing.frame import SensorFrame
from vibrissa.sensing.mixing import MixingCalibration, calibrate_mixing
from vibrissa.sensing.mounting import FrameCalibration, calibrate_frame
from vibrissa.sensing.sensor import COMPONENTS, FORCE_NOISE, MOMENT_NOISE, Sensor
from vibrissa.sensing.stiffness import StiffnessFit, fit_stiffness
from vibrissa.sensing.weight import WeightCalibration, calibrate_weight, tare

__all__ = [
    "COMPONENTS",
    "FORCE_NOISE",
    "MOMENT_NOISE",
    "FrameCalibration",
    "MixingCalibration",
    "Sensor",
    "SensorFrame",
    "StiffnessFit",
    "WeightCalibration",
    "calibrate_frame",
    "calibrate_mixing",
    "calibrate_on_contacts",
    "calibrate_weight",
    "fit_stiffness",
    "load_sensor",
    "save_sensor",
    "tare",
]
