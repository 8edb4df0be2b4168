"""Tests of octoseg_ti.files."""
