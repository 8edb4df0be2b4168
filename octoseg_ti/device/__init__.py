"""Everything that knows Taichi but nothing of scans."""
