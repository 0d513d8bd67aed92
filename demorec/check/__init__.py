"""Is a recording what it says? One check per function, each with its limits; none needs the simulator."""
