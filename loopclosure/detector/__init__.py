"""Finds loops while images arrive, or in recordings."""

from loopclosure.detector.decision import DetectorSettings, LoopResult
from loopclosure.detector.detector import LoopDetector

__all__ = ["DetectorSettings", "LoopDetector", "LoopResult"]
