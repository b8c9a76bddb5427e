"""Control of teams: consensus, collision avoidance, cooperative and central MPC."""
