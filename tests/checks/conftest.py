"""The shared fixtures for tests of rules."""

from tests.checks.checked import checked, checked_rules

__all__ = ["checked", "checked_rules"]
