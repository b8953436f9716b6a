"""From the arrays of a recording to curves, features, tables, figures and reports. Opens no instrument."""
