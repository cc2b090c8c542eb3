"""A benchmark of redundancy resolution, made of what users report; see README.md."""
