"""The fixture of all tests of rules."""

from tests.checks.checked import checked

__all__ = ["checked"]
