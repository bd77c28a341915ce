"""The shared fixture for tests of rules."""

from tests.checks.checked import checked

__all__ = ["checked"]
