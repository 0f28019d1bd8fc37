"""The sensor at the whisker's base: what it reads, how it is mounted, how to calibrate it."""

from vibrissa.sensors.contacts import calibrate_on_contacts
from vibrissa.sensors.files import load_sensor, save_sensor
from vibrissa.sensors.frame import SensorFrame
from vibrissa.sensors.mixing import MixingCalibration, calibrate_mixing
from vibrissa.sensors.mounting import FrameCalibration, calibrate_frame
from vibrissa.sensors.sensor import COMPONENTS, FORCE_NOISE, MOMENT_NOISE, Sensor
from vibrissa.sensors.stiffness import StiffnessFit, fit_stiffness
from vibrissa.sensors.weight import WeightCalibration, calibrate_weight, tare

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
