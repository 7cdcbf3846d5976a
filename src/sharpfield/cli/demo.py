"""The demo: record a scene, deblur it three ways in the same time, and show the difference."""
