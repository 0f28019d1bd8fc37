"""The sensor at the whisker's base: its readings, mounting and calibration."""

from vibrissa.sensors.files import load_sensor, save_sensor
from vibrissa.sensors.frame import FrameCalibration, SensorFrame, calibrate_frame
from vibrissa.sensors.mixing import (
    MixingCalibration,
    calibrate_mixing,
    calibrate_on_contacts,
)
from vibrissa.sensors.sensor import COMPONENTS, FORCE_NOISE, GRAVITY, MOMENT_NOISE, Sensor
from vibrissa.sensors.stiffness import StiffnessFit, fit_stiffness
from vibrissa.sensors.weight import WeightCalibration, calibrate_weight, tare

__all__ = [
    "COMPONENTS",
    "FORCE_NOISE",
    "GRAVITY",
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
