"""Closing loops as images arrive, and on recordings."""

from loopclosure.detector.decision import DetectorSettings, LoopResult
from loopclosure.detector.detector import LoopDetector

__all__ = ["DetectorSettings", "LoopDetector", "LoopResult"]
