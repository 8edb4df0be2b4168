"""The method, one stage a file; no stage imports another but the grid."""
