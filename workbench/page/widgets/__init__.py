"""Building blocks of panels: inputs, charts, buttons, templates."""
