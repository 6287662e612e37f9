"""A stress sweep: one scene, changed along axes, rendered and perceived many times, and where it fails.

The way of the data: a campaign document (`campaign`, its `axes`) becomes jobs (`jobs`), which worker
processes do one by one (`execute`, `workers`), each leaving one file; the files become one table (`table`),
of which `metrics` and their `reach` are made.
"""
