"""The nouns of the house: what flows from a recording to a rendered image."""
