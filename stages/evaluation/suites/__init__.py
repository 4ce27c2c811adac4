"""Benchmark suites, one module each: where a suite's scenes lie in its published layout, and which photos are tests.

A suite's module has `find_scenes(folder, wanted)`, which only looks at names of files; `registry` lists them.
"""
