"""Sharp radiance fields from motion-blurred frames and event-camera streams.

A sensor reports a *measurement* of a sharp scene; a *recipe* says which sharp rays explain each
measurement, and how they combine::

    observed = outer( sum_k  w_k * inner( L_k ) )          L_k: sharp light along ray k

Six verbs carry every recipe, each with its own folder: read and draw (`captures`), expose and
observe (`formation`), render (`rendering`), compare (`losses`). What flows between them lives in
`core`. Start reading at `core/protocols.py`.
"""

__version__ = "0.1.0"
