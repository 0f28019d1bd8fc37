"""Sensors at the whisker's base: readings, frame and calibration."""

from vibrissa.sensors.calibration import (
    MixingCalibration,
    WeightCalibration,
    calibrate_mixing,
    calibrate_on_contacts,
    calibrate_weight,
    tare,
)
from vibrissa.sensors.files import (
    Stage as Stage,
    StageSweep as StageSweep,
    StageTouches as StageTouches,
    load_sensor,
    load_suspended as load_suspended,
    save_sensor,
    save_suspended as save_suspended,
)
from vibrissa.sensors.frame import (
    FrameCalibration,
    SensorFrame,
    calibrate_frame,
    component_noise as component_noise,
)
from vibrissa.sensors.regression import ThinPlate as ThinPlate
from vibrissa.sensors.sensor import COMPONENTS, FORCE_NOISE, GRAVITY, MOMENT_NOISE, Sensor
from vibrissa.sensors.stiffness import StiffnessFit, fit_stiffness
from vibrissa.sensors.suspended import (
    SuspendedWhisker,
    SweptContacts,
    Touches as Touches,
    follow_sweep,
)
from vibrissa.sensors.suspension import SuspensionCalibration, calibrate_suspension

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
    "SuspendedWhisker",
    "SuspensionCalibration",
    "SweptContacts",
    "WeightCalibration",
    "calibrate_frame",
    "calibrate_mixing",
    "calibrate_on_contacts",
    "calibrate_suspension",
    "calibrate_weight",
    "fit_stiffness",
    "follow_sweep",
    "load_sensor",
    "save_sensor",
    "tare",
]
__dir__ = __all__.copy
