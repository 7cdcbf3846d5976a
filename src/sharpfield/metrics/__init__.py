"""Numbers to report, never to train on."""
