"""The report of a diagnosis: words, document, figures and the page."""

from jaxvm.report.document import document
from jaxvm.report.figures import figures
from jaxvm.report.page import write_report
from jaxvm.report.words import summary

__all__ = ["document", "figures", "summary", "write_report"]
