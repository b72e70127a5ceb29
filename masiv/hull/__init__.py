"""Visual hulls from silhouettes."""
