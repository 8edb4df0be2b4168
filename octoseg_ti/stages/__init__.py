"""The method, one stage a file, in the order of the paper; no stage imports another but the grid."""
