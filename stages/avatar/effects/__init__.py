"""What only some clips call for: one file an effect, each with the numbers it was measured at. Off, none of it runs."""
