"""Pages and pictures made from a run directory alone."""

from etsplat.report.html import write_report as write_report
