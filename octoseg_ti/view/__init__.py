"""What people look at: Rerun recordings, pictures, reports."""
