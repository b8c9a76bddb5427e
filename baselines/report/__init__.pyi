# The public names, once: type checkers read this file, and `__init__.py` loads by it.
from .build import Choice as Choice
from .build import build_report as build_report
from .build import render_report as render_report
from .page import render_page as render_page
