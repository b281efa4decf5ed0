"""Closing loops as images arrive, and on recordings."""

from loopclosure.detector.detector import DetectorSettings, LoopDetector, LoopResult

__all__ = ["DetectorSettings", "LoopDetector", "LoopResult"]
