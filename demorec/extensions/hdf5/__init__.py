"""Export recordings to one HDF5 file in robomimic's layout; the only importer of h5py."""
