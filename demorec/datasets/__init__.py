"""What all exporters share: which recordings go in, their numbers, common options, folders made as a whole."""
