#!/usr/bin/env python3
"""Makes the embedded scenarios, CommonRoad XML 2020a, beside this script. Needs Python only.

    python3 vehicle/scenarios/generate.py

A road is a reference line with piecewise linear curvature; lane 0 is the rightmost one. A vehicle is
scripted as long as its trajectory says something; from then on the simulation drives it by itself, at
most at the highest speed of its trajectory. So a vehicle that only keeps its speed has two states.
"""

import math
from pathlib import Path

STEP_S = 0.5
WIDTH = 3.5
SPACING = 20.0
HEADER = '<?xml version="1.0" encoding="UTF-8"?>\n<!-- Made by generate.py: edit that, not this. -->\n'


class Line:
    """A reference line: curvature (1/m) linear between (station, curvature) points."""

    def __init__(self, length, curvature, step=1.0):
        self.step, self.points = step, []
        x = y = heading = 0.0
        for i in range(int(length / step) + 2):
            self.points.append((x, y, heading))
            k = self.interpolate(curvature, (i + 0.5) * step)
            x += step * math.cos(heading + k * step / 2)
            y += step * math.sin(heading + k * step / 2)
            heading += k * step

    @staticmethod
    def interpolate(knots, s):
        for (s0, k0), (s1, k1) in zip(knots, knots[1:]):
            if s0 <= s <= s1:
                return k0 + (k1 - k0) * (s - s0) / (s1 - s0)
        return knots[-1][1]

    def at(self, s, d):
        i = max(0, min(int(s / self.step), len(self.points) - 2))
        t = s / self.step - i
        (x0, y0, h0), (x1, y1, h1) = self.points[i], self.points[i + 1]
        heading = h0 + (h1 - h0) * t
        x, y = x0 + (x1 - x0) * t, y0 + (y1 - y0) * t
        return x - d * math.sin(heading), y + d * math.cos(heading), heading


def offset(lane):
    return lane * WIDTH


class Vehicle:
    """Moves along the road by a list of (until, acceleration, lane change or None)."""

    def __init__(self, s, lane, speed, kind="car", script=(), size=None):
        self.s, self.lane, self.speed, self.kind, self.script = s, lane, speed, kind, script
        self.size = size or ((12.0, 2.5) if kind == "truck" else (4.6, 1.85))

    def states(self, line):
        """(x, y, heading, speed) every STEP_S, computed in steps of 10 ms."""
        end = max((until for until, *_ in self.script), default=STEP_S)
        s, v, d, result = self.s, self.speed, offset(self.lane), []
        for i in range(round(end / 0.01) + 1):
            t = i * 0.01
            d_before = d
            d = offset(self.lane)
            acceleration, begin = 0.0, 0.0
            for until, a, target in self.script:
                if target is not None:
                    share = min(1.0, max(0.0, (t - begin) / (until - begin)))
                    # Quintic: no jump in speed or acceleration at either end.
                    blend = share**3 * (10 - 15 * share + 6 * share**2)
                    d += (offset(target) - self.final_lane_before(begin)) * blend
                if begin <= t < until:
                    acceleration = a
                begin = until
            if i % round(STEP_S / 0.01) == 0:
                x, y, heading = line.at(s, d)
                drift = (d - d_before) / 0.01 if i else 0.0
                result.append((x, y, heading + math.atan2(drift, max(v, 1.0)), v))
            s += max(0.0, v * 0.01 + acceleration * 0.00005)
            v = max(0.0, v + acceleration * 0.01)
        return result

    def final_lane_before(self, t):
        lane = self.lane
        for until, _, target in self.script:
            if until <= t and target is not None:
                lane = target
        return offset(lane)


def point(x, y):
    return f"<point><x>{x:.2f}</x><y>{y:.2f}</y></point>"


def exact(name, value, digits=3):
    return f"<{name}><exact>{value:.{digits}f}</exact></{name}>"


def state(name, index, x, y, heading, v, more=""):
    heading = math.atan2(math.sin(heading), math.cos(heading))
    return (
        f"<{name}><position>{point(x, y)}</position>{exact('orientation', heading, 4)}"
        f"<time><exact>{index}</exact></time>{exact('velocity', v, 2)}{more}</{name}>"
    )


def lanelets(line, length, sections):
    """Lanelets for sections of (begin, end, lanes)."""
    out, number = [], lambda section, lane: 100 * (section + 1) + lane
    for index, (begin, end, lanes) in enumerate(sections):
        stations = [begin + i * SPACING for i in range(int((end - begin) / SPACING))] + [end]
        for lane in lanes:
            bound = lambda side: "".join(
                "\n      " + point(*line.at(s, offset(lane) + side * WIDTH / 2)[:2]) for s in stations
            )
            links = ""
            if index > 0 and lane in sections[index - 1][2]:
                links += f'\n    <predecessor ref="{number(index - 1, lane)}"/>'
            if index + 1 < len(sections) and lane in sections[index + 1][2]:
                links += f'\n    <successor ref="{number(index + 1, lane)}"/>'
            if lane + 1 in lanes:
                links += f'\n    <adjacentLeft ref="{number(index, lane + 1)}" drivingDir="same"/>'
            if lane - 1 in lanes:
                links += f'\n    <adjacentRight ref="{number(index, lane - 1)}" drivingDir="same"/>'
            out.append(
                f'  <lanelet id="{number(index, lane)}">\n    <leftBound>{bound(1)}\n    </leftBound>\n'
                f"    <rightBound>{bound(-1)}\n    </rightBound>{links}\n"
                "    <laneletType>highway</laneletType>\n"
                '    <trafficSignRef ref="900"/>\n  </lanelet>\n'
            )
    return "".join(out), number(0, sections[0][2][0])


def shape(length, width):
    return (
        f"<shape><rectangle><length>{length}</length><width>{width}</width></rectangle></shape>"
    )


def write(name, number, curvature, sections, limit, ego, vehicles, things=()):
    length = sections[-1][1]
    line = Line(length, curvature)
    road, lanelet = lanelets(line, length, sections)
    text = HEADER + (
        '<commonRoad timeStepSize="0.5" commonRoadVersion="2020a" author="Tandem"'
        f' affiliation="Tandem" source="synthetic" benchmarkID="ZAM_Tandem-{number}_1_T-1"'
        ' date="2026-01-01">\n'
        "  <location><geoNameId>-999</geoNameId><gpsLatitude>999</gpsLatitude>"
        "<gpsLongitude>999</gpsLongitude></location>\n"
        "  <scenarioTags><highway/><multi_lane/></scenarioTags>\n"
    )
    text += road
    text += (
        '  <trafficSign id="900">\n    <trafficSignElement><trafficSignID>274</trafficSignID>'
        f"<additionalValue>{limit:.2f}</additionalValue></trafficSignElement>\n"
        f"    <position>{point(*line.at(0, offset(0) - WIDTH)[:2])}</position>\n"
        "    <virtual>true</virtual>\n  </trafficSign>\n"
    )
    rest = exact("yawRate", 0, 1) + exact("slipAngle", 0, 1)
    for index, (s, lane, kind, size) in enumerate(things):
        x, y, heading = line.at(s, offset(lane))
        text += (
            f'  <staticObstacle id="{700 + index}">\n    <type>{kind}</type>\n    {shape(*size)}\n'
            f"    <initialState><position>{point(x, y)}</position>"
            f"{exact('orientation', heading, 4)}<time><exact>0</exact></time></initialState>\n"
            "  </staticObstacle>\n"
        )
    for index, vehicle in enumerate(vehicles):
        first, *others = vehicle.states(line)
        text += (
            f'  <dynamicObstacle id="{500 + index}">\n    <type>{vehicle.kind}</type>\n'
            f"    {shape(*vehicle.size)}\n    {state('initialState', 0, *first)}\n"
            "    <trajectory>\n"
        )
        for step, values in enumerate(others, 1):
            text += f"      {state('state', step, *values)}\n"
        text += "    </trajectory>\n  </dynamicObstacle>\n"
    s, lane, speed = ego
    x, y, heading = line.at(s, offset(lane))
    text += (
        f'  <planningProblem id="1">\n    {state("initialState", 0, x, y, heading, speed, rest)}\n'
        "    <goalState><time><intervalStart>0</intervalStart><intervalEnd>120</intervalEnd></time>"
        "</goalState>\n  </planningProblem>\n</commonRoad>\n"
    )
    Path(__file__).with_name(f"{name}.xml").write_text(text)


# Curves of 1200 to 2000 m radius, entered and left gradually.
CURVES = [(0, 0), (500, 0), (700, 1 / 1500), (1000, 1 / 1500), (1250, -1 / 1200), (1600, -1 / 1200),
          (1800, 0), (2200, 1 / 2000), (2500, 0)]
GENTLE = [(0, 0), (600, 0), (800, -1 / 1800), (1200, -1 / 1800), (1400, 0), (3000, 0)]
EGO_S = 200.0
END = 2600.0


def at(ahead):
    return EGO_S + ahead


def main():
    three, two = [(0, END, [0, 1, 2])], [(0, END, [0, 1])]
    write("free-lane", 1, CURVES, three, 33.33, (EGO_S, 1, 30.0), [
        Vehicle(at(90), 0, 24.0, "truck"),
        Vehicle(at(210), 0, 24.0, "truck"),
        Vehicle(at(-70), 0, 25.0),
        Vehicle(at(130), 1, 34.0),
        Vehicle(at(-60), 1, 31.0),
        Vehicle(at(-80), 2, 37.0),
        Vehicle(at(-160), 2, 36.0),
        Vehicle(at(150), 2, 36.0),
    ])
    write("slow-leader", 2, CURVES, two, 33.33, (EGO_S, 0, 32.0), [
        Vehicle(at(140), 0, 22.0, "truck"),
        Vehicle(at(-25), 1, 36.0),
        Vehicle(at(-75), 1, 36.0),
        Vehicle(at(100), 1, 35.0),
        Vehicle(at(-80), 0, 30.0),
        Vehicle(at(480), 0, 22.0, "truck"),
    ])
    write("cut-in", 3, GENTLE, three, 30.56, (EGO_S, 1, 30.0), [
        # Pulls out from behind a truck, 13 m ahead of the ego and 7 m/s slower.
        Vehicle(at(57), 0, 23.0, script=[(4, 0, None), (7.5, 0, 1), (14, 0, None), (20, 1.0, None)]),
        Vehicle(at(110), 0, 21.0, "truck"),
        # A column of cars on the left prevents the ego from overtaking.
        Vehicle(at(-12), 2, 31.0),
        Vehicle(at(28), 2, 31.0),
        Vehicle(at(-55), 2, 31.0),
        # Changes from the left into the gap behind the vehicle that cuts in first.
        Vehicle(at(65), 2, 27.5, script=[(22, -0.02, None), (26, 0, 1), (30, 0, None)]),
        Vehicle(at(-60), 1, 29.0),
        Vehicle(at(-90), 0, 24.0),
    ])
    drop = EGO_S + 850.0
    write("lane-drop", 4, GENTLE, [(0, drop, [0, 1, 2]), (drop, END, [1, 2])], 27.78,
          (EGO_S, 0, 27.0), [
        Vehicle(at(-20), 1, 26.5),
        Vehicle(at(30), 1, 26.0),
        Vehicle(at(95), 1, 26.0),
        Vehicle(at(-70), 1, 26.5),
        Vehicle(at(-150), 1, 27.0),
        Vehicle(at(0), 2, 30.0),
        Vehicle(at(-60), 2, 30.0),
        Vehicle(at(70), 2, 29.5),
        # Not in the middle: it drives on in the lane that ends, and has to stop if it cannot merge.
    ], things=[(drop + 15, 0, "constructionZone", (8.0, 2.5))])
    write("hard-braking", 5, GENTLE, two, 33.33, (EGO_S, 0, 30.0), [
        # 30 to 5 m/s with 7 m/s²; later to 12 m/s with 6 m/s².
        Vehicle(at(60), 0, 30.0, script=[
            (10, 0, None), (13.571, -7.0, None), (18, 0, None), (31, 1.7, None), (37, 0, None),
            (39.5, -6.0, None), (43, 0, None), (54, 1.4, None), (56, 0, None)]),
        Vehicle(at(-45), 0, 30.0),
        Vehicle(at(-15), 1, 30.0, script=[(10.5, 0, None), (15, -5.0, None), (19, 0, None),
                                          (32, 1.6, None)]),
        Vehicle(at(35), 1, 30.0, script=[(10.2, 0, None), (14.2, -6.0, None), (18, 0, None),
                                         (32, 1.6, None)]),
        Vehicle(at(-65), 1, 30.0),
    ])
    write("stop-and-go", 6, GENTLE, two, 27.78, (EGO_S, 0, 24.0), [
        Vehicle(at(60), 0, 22.0, script=[
            (3, 0, None), (12, -2.5, None), (15, 0, None), (22, 1.4, None), (25, 0, None),
            (30, -2.2, None), (34, 0, None), (46, 1.5, None), (56, 0.6, None)]),
        Vehicle(at(45), 1, 23.0, script=[
            (4, 0, None), (13, -2.6, None), (17, 0, None), (25, 1.3, None), (31, -2.0, None),
            (35, 0, None), (48, 1.5, None)]),
        Vehicle(at(-40), 0, 23.0),
        Vehicle(at(-90), 0, 23.0),
        Vehicle(at(0), 1, 23.0),
        Vehicle(at(-45), 1, 23.0),
        Vehicle(at(-100), 1, 24.0, "truck"),
    ])
    # Nobody else: the vehicle stands, and an SoC may park it.
    write("parking", 7, [(0, 0), (1200, 0)], [(0, 1200.0, [0])], 8.33, (EGO_S, 0, 0.0), [])


if __name__ == "__main__":
    main()
