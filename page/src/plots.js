"use strict";
// Draws the plots of a page by uPlot, from the data that `page/src/plot.rs` writes. All plots over
// time show the same span. A drag zooms them, a double click shows the whole run.
const plots = (() => {
  // Half of the span around a chosen moment, s.
  const AROUND_S = 1;
  // The shortest span, s: a few microseconds, as exact as the data.
  const SHORTEST_S = 0.000_02;
  const FONT = "12px system-ui, sans-serif";
  const places = new Map();
  const bar = document.getElementById("moment");
  let span = null;
  let moment = null;

  const color = (name) =>
    getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  const plain = (value) => String(Number(value.toFixed(6)));
  const isOverTime = (plot) => plot.spec.x.scale === "time";
  const isFixed = (plot) => plot.place.hasAttribute("data-live");

  // Returns the columns that uPlot draws. Series with times of their own are joined.
  function columns(spec) {
    if (spec.spans.length > 0) {
      return columnsOfSpans(spec);
    }
    if (spec.series.length === 0) {
      return [[]];
    }
    return uPlot.join(spec.series.map((it) => [it.x, it.y]));
  }

  // Rows of states: for each row the number of its span at each time.
  function columnsOfSpans(spec) {
    const [from, to] = spec.x.range;
    const count = 4000;
    const times = Array.from({ length: count + 1 }, (_, i) => from + ((to - from) * i) / count);
    const row = (tick) => {
      const mine = spec.spans.filter((it) => it.low <= tick && tick <= it.high);
      let next = 0;
      return times.map((time) => {
        while (next < mine.length && mine[next].to < time) {
          next += 1;
        }
        const has = next < mine.length && mine[next].from <= time;
        return has ? spec.spans.indexOf(mine[next]) : null;
      });
    };
    return [times, ...rows(spec).map(([tick]) => row(tick))];
  }

  const rows = (spec) => spec.y.ticks.toReversed();

  function series(plot) {
    const { spec } = plot;
    if (spec.spans.length > 0) {
      const value = (_, index) => (index === null ? "–" : spec.spans[index]?.name ?? "–");
      const row = ([, label]) => ({ label, value, paths: () => null, points: { show: false } });
      return rows(spec).map(row);
    }
    const unit = spec.y.name.split(",")[0];
    const value = (_, y) => {
      if (y === null || y === undefined) {
        return "–";
      }
      const shown = spec.y.scale === "decades" ? 10 ** y : y;
      return `${Number(shown.toPrecision(4))} ${unit}`.trim();
    };
    return spec.series.map((it) => {
      const stroke = color(it.color);
      const common = { label: it.name || spec.title, value, stroke };
      if (it.style === "dots") {
        const points = { show: true, size: 3.5, width: 0, fill: stroke };
        return { ...common, paths: () => null, points };
      }
      const dash = it.style === "dashed" ? [6, 4] : undefined;
      return { ...common, width: it.width, dash, points: { show: false } };
    });
  }

  // The nearest value of a series, where another series has a time of its own.
  function nearest(u, of, index) {
    const values = u.data[of];
    if (of === 0 || values[index] !== undefined) {
      return index;
    }
    for (let away = 1; away < 500; away += 1) {
      for (const at of [index - away, index + away]) {
        if (values[at] !== undefined && values[at] !== null) {
          return at;
        }
      }
    }
    return index;
  }

  // Draws into the rectangle of the plot only.
  function within(u, draw) {
    const { left, top, width, height } = u.bbox;
    u.ctx.save();
    u.ctx.beginPath();
    u.ctx.rect(left, top, width, height);
    u.ctx.clip();
    draw(u.ctx);
    u.ctx.restore();
  }

  function drawSpans(plot, u) {
    within(u, (ctx) => {
      for (const it of plot.spec.spans) {
        const [left, right] = [it.from, it.to].map((x) => u.valToPos(x, "x", true));
        const [top, bottom] = [it.high, it.low].map((y) => u.valToPos(y, "y", true));
        ctx.fillStyle = color(it.color);
        ctx.fillRect(left, top, Math.max(right - left, 1), bottom - top);
      }
    });
  }

  function drawMarks(plot, u) {
    const line = (ctx, x, stroke, dash) => {
      const at = Math.round(u.valToPos(x, "x", true)) + 0.5;
      ctx.strokeStyle = color(stroke);
      ctx.lineWidth = devicePixelRatio;
      ctx.setLineDash(dash.map((it) => it * devicePixelRatio));
      ctx.beginPath();
      ctx.moveTo(at, u.bbox.top);
      ctx.lineTo(at, u.bbox.top + u.bbox.height);
      ctx.stroke();
    };
    within(u, (ctx) => {
      plot.spec.marks.forEach((x) => line(ctx, x, "red", [4, 4]));
      if (moment !== null && isOverTime(plot)) {
        line(ctx, moment, "ink", []);
      }
    });
  }

  function options(plot) {
    const { spec, place } = plot;
    const axis = { stroke: color("muted"), font: FONT, labelFont: FONT, labelSize: 16 };
    const grid = { stroke: color("line"), width: 1 };
    const onX = { ...axis, grid, ticks: grid, size: 30, values: (_, all) => all.map(plain) };
    if (spec.x.scale === "nines") {
      onX.splits = () => spec.x.ticks.map(([at]) => at);
      onX.values = () => spec.x.ticks.map(([, label]) => label);
    }
    const xName = isOverTime(plot) ? "s" : spec.x.name;
    return {
      width: place.clientWidth,
      height: spec.height,
      padding: [8, 12, 0, 0],
      scales: {
        x: { time: false, range: () => plot.range },
        y: { range: () => plot.spec.y.range },
      },
      axes: [
        onX,
        {
          ...axis,
          grid: spec.spans.length > 0 ? { show: false } : grid,
          ticks: { show: false },
          size: 46,
          label: spec.y.name,
          splits: () => plot.spec.y.ticks.map(([at]) => at),
          values: () => plot.spec.y.ticks.map(([, label]) => label),
        },
      ],
      series: [
        {
          label: isOverTime(plot) ? "at" : xName,
          value: (_, x) => (x === null ? "–" : isOverTime(plot) ? `${x.toFixed(4)} s` : label(spec.x, x)),
        },
        ...series(plot),
      ],
      legend: { markers: { fill: (_, of) => marker(plot, of), stroke: () => "none", width: 0 } },
      cursor: {
        y: false,
        dataIdx: nearest,
        sync: isOverTime(plot) ? { key: "time", setSeries: false, filters: { pub: isMove } } : undefined,
        drag: { x: !isFixed(plot), y: false, setScale: false },
        points: { show: spec.spans.length === 0, size: 7 },
        bind: { dblclick: () => () => showWhole(plot) },
      },
      hooks: {
        drawClear: [(u) => drawSpans(plot, u)],
        draw: [(u) => drawMarks(plot, u)],
        setSelect: [(u) => select(plot, u)],
      },
    };
  }

  // The other plots follow the pointer; a drag is passed on by `show`.
  const isMove = (type) => type === "mousemove" || type === "mouseleave";

  function label(axis, x) {
    return axis.scale === "nines" ? `${plain(100 - 10 ** (2 - x))} %` : plain(x);
  }

  function marker(plot, of) {
    const it = plot.spec.series[of - 1];
    return it === undefined ? "none" : `var(--${it.color})`;
  }

  // The end of a drag: shows what was selected.
  function select(plot, u) {
    const { left, width } = u.select;
    if (width > 0) {
      u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
      const [from, to] = [left, left + width].map((at) => u.posToVal(at, "x"));
      isOverTime(plot) ? show(from, to) : scale(plot, [from, to]);
    }
  }

  function scale(plot, [from, to]) {
    plot.range = [from, to];
    plot.u.setScale("x", { min: from, max: to });
  }

  function showWhole(plot) {
    if (!isFixed(plot)) {
      isOverTime(plot) ? show(...plot.spec.x.range) : scale(plot, plot.spec.x.range);
    }
  }

  const overTime = () => [...places.values()].filter((plot) => isOverTime(plot));

  // Shows this span of the run in all plots over time.
  function show(from, to) {
    const [first, last] = whole();
    const width = Math.min(Math.max(to - from, SHORTEST_S), last - first);
    const begin = Math.min(Math.max(from, first), last - width);
    span = [begin, begin + width];
    overTime().forEach((plot) => scale(plot, span));
    tell();
  }

  function whole() {
    return overTime()[0]?.spec.x.range ?? [0, 1];
  }

  // Moves all plots over time to a moment of the run, s, and names it.
  function moveTo(at) {
    const [from, to] = span ?? whole();
    const half = Math.min(AROUND_S, (to - from) / 2);
    moment = at;
    show(at - half, at + half);
    overTime().forEach((plot) => plot.u.redraw(false));
  }

  // Returns a time as ui.perfetto.dev writes it: since the trace's first event.
  function inTrace(ns) {
    const digits = (value, count) => String(value).padStart(count, "0");
    const [s, us] = [Math.floor(ns / 1e9), Math.floor((ns % 1e9) / 1e3)];
    const clock = [Math.floor(s / 3600), Math.floor(s / 60) % 60, s % 60].map((it) => digits(it, 2));
    return `${clock.join(":")}.${digits(Math.floor(us / 1000), 3)} ${digits(us % 1000, 3)}`;
  }

  function tell() {
    if (bar === null) {
      return;
    }
    const [from, to] = span ?? whole();
    const digits = to - from < 1 ? 4 : 1;
    bar.querySelector(".span").textContent = `${from.toFixed(digits)} to ${to.toFixed(digits)} s`;
    if (moment !== null) {
      const ns = Math.round(moment * 1e9) + Number(bar.dataset.startNs);
      const since = inTrace(ns - Number(bar.dataset.traceNs));
      const clock = ns.toString().replace(/\B(?=(\d{3})+$)/g, " ");
      bar.querySelector(".at").innerHTML =
        `<b>${moment.toFixed(4)} s</b> of the scenario is <b>${since}</b> in the trace (clock: ${clock} ns)`;
    }
  }

  // Zooms by a factor, around the chosen moment or the middle.
  function zoom(factor) {
    const [from, to] = span ?? whole();
    const isIn = moment !== null && from <= moment && moment <= to;
    const middle = isIn ? moment : (from + to) / 2;
    const half = ((to - from) / 2) * factor;
    show(middle - half, middle + half);
  }

  function create(plot) {
    plot.u?.destroy();
    plot.u = new uPlot(options(plot), columns(plot.spec), plot.place);
  }

  // Draws this data at this place from now on.
  function put(place, spec) {
    let plot = places.get(place);
    if (plot === undefined) {
      plot = { place, spec, range: spec.x.range };
      places.set(place, plot);
      create(plot);
      new ResizeObserver(() => resize(plot)).observe(place);
      return;
    }
    const isSame = plot.spec.series.length === spec.series.length;
    plot.spec = spec;
    plot.range = spec.x.range;
    if (!isSame) {
      create(plot);
      return;
    }
    plot.u.setData(columns(spec), false);
    plot.u.batch(() => {
      scale(plot, spec.x.range);
      plot.u.setScale("y", { min: spec.y.range[0], max: spec.y.range[1] });
    });
  }

  function resize(plot) {
    const width = plot.place.clientWidth;
    if (width > 0 && width !== plot.u.width) {
      plot.u.setSize({ width, height: plot.spec.height });
    }
  }

  for (const data of document.querySelectorAll(".plot > script")) {
    put(data.parentElement, JSON.parse(data.textContent));
  }
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    places.forEach(create);
  });
  document.addEventListener("click", (event) => {
    const { at, zoom: factor } = event.target.closest("button")?.dataset ?? {};
    if (at !== undefined) {
      moveTo(Number(at));
    } else if (factor === "whole") {
      show(...whole());
    } else if (factor !== undefined) {
      zoom(Number(factor));
    }
  });
  tell();
  return { put, moveTo, show, all: () => [...places.values()] };
})();
