"""The page that tells how a run went, made from its folder alone, so it can be remade from any recording."""

from ground_station.report.page import write_report

__all__ = ["write_report"]
