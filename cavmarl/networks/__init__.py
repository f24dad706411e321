"""Networks of trained drivers: their files, and their evaluation by kernels instead of torch."""
