"""The shared fixtures for tests of rules."""

from tests.checks.checked import checked, checked_rules
from tests.checks.given import example, judged

__all__ = ["checked", "checked_rules", "example", "judged"]
