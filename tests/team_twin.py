"""The step, the rewards and the observations of teams in readable numpy, float64 throughout.

Who is heard, how old a message is, who is sensed in which slot and who flies are given, as in the adjoint.
"""

import numpy as np
from control_period import control_period

from quad_envs.constraints import TOLERANCE, constraint_scales, constraint_values
from quad_envs.observations.team import COMM_OFFSET, COMM_POSITION
from quad_envs.reward import stage_cost
from quad_envs.rotations import rotation_body_from_inertial


def motions_of(plants):
    """p, inertial v, phi, theta, sin psi, cos psi, (n, 10)."""
    v = np.einsum("nji,nj->ni", rotation_body_from_inertial(plants[:, 6:9]), plants[:, 3:6])
    psi = plants[:, 8:9]
    return np.concatenate([plants[:, :3], v, plants[:, 6:8], np.sin(psi), np.cos(psi)], axis=1)


class TeamTwin:
    """What `DifferentiableTeams` does step by step, for flights whose steps and observations are known."""

    def __init__(self, flights, steps, seen, kept):
        self.flights, self.steps, self.kept, self.seen = flights, steps, kept, seen
        self.batch, self.task, self.options = flights.batch, flights.task, flights.batch.options
        self.mates = np.arange(flights.n).reshape(flights.teams, -1)
        self.team = np.arange(flights.n) // self.task.vehicles

    def advance(self, t, plants, commands, previous):
        """Plants after step t, rewards and costs with `kept` as the distance to keep."""
        record, n = self.steps[t].record, self.flights.n
        flown = control_period(plants, commands, self.task, self.options.substeps, record.disturbances)
        places, after = [one[:, :3] for one in flown], flown[-1]
        loss = stage_cost(after, record.wanted, commands, self.task.hover_force, self.task.weights)
        values = constraint_values(after, commands, previous, self.task.limits, self.task.dt)
        scales = constraint_scales(self.task.limits, self.task.dt)
        limits = np.where(values > TOLERANCE, values / scales, 0.0).sum(axis=1)
        nearest, formation = np.full(n, 2.0 * self.options.arena), np.zeros(n)
        table, K = self.batch.arrays.tables, self.batch.neighbours.shape[1]
        for r in range(n):
            others = [j for j in self.mates[self.team[r]] if j != r and record.flew[j]]
            for p in places:
                nearest[r] = min([nearest[r], *np.linalg.norm(p[others] - p[r], axis=1)])
            graph = self.batch.graph(min(record.steps[r] + 1, len(table.schedule) - 1))
            i, first = r % self.task.vehicles, self.mates[self.team[r], 0]
            errors = []
            for s in range(K):
                j = self.batch.neighbours[i, s]
                if j >= 0 and graph[i, j] > 0.0 and record.flew[first + j]:
                    offset = self.batch.slots[i] - self.batch.slots[j]
                    errors.append(((after[r, :3] - after[first + j, :3] - offset) ** 2).sum())
            formation[r] = np.mean(errors) if errors else 0.0
        loss = loss + self.task.formation_weight * formation
        room = self.task.separation - self.task.crash_distance
        too_near = [distance - nearest for distance in (self.task.separation, self.kept)]
        close, closer = (np.where(gap > TOLERANCE, gap, 0.0) / room for gap in too_near)
        rewards = (1.0 - np.minimum(1.0, limits + close)) / (1.0 + loss)
        return after, rewards, limits + closer

    def observe(self, t, plants, previous, motions):
        """Observations before step t, (n, size); motions of all steps up to t."""
        record, layout, size = self.steps[t].record, self.task.layout, self.task.vehicles
        out, now = self.seen[t].astype(np.float64), motions[t]
        where = layout.slices
        psi = plants[:, 8:9]
        out[:, where["own"]] = np.concatenate(
            [plants[:, 3:8], np.sin(psi), np.cos(psi), plants[:, 9:], previous], axis=1
        )
        if layout.position:
            out[:, where["position"]] = plants[:, :3]
        for r in np.flatnonzero(record.flew):
            if r % size == 0 and self.options.has_leader:
                reference = self.batch.arrays.tables.references[0]
                stages = layout.preview + 1
                k = min(record.steps[r], len(reference) - stages)
                rows = reference[k : k + stages, :8].copy()
                rows[:, :3] -= plants[r, :3]
                out[r, where["preview"]] = rows.ravel()
            comm = out[r, where["comm"]].reshape(layout.neighbours, -1)  # weights and ages are those given
            for s in range(layout.neighbours):
                age = record.ages[r, s]
                if age >= 0 and age <= t:
                    j = self.batch.neighbours[r % size, s]
                    message = motions[t - age][r - r % size + j].copy()
                    message[:6] -= now[r, :6]
                    comm[s, COMM_POSITION.start : COMM_OFFSET.start] = message
                elif age > t:  # it was sent before the window
                    comm[s, 2:8] += self.seen_motions[t][r, :6] - now[r, :6]
            sensed = out[r, where["sensed"]].reshape(layout.sensed, 7)
            for slot in (row for row in sensed if row[0] > 0.0):
                others = [j for j in self.mates[self.team[r]] if j != r and record.flew[j]]
                was = self.seen_motions[t]
                j = others[int(np.argmin(np.abs(was[others, :3] - was[r, :3] - slot[1:4]).sum(axis=1)))]
                slot[1:] = now[j, :6] - now[r, :6]
        return out

    @property
    def seen_motions(self):
        """Motions as they were flown, step by step."""
        return [motions_of(step.record.plants) for step in self.steps]
