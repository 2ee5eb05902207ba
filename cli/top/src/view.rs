//! The screen of `tandem top`: 80 by 24 characters, or larger in a larger terminal.

use ratatui::Frame;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::{Color, Modifier, Style};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Block, Paragraph, Sparkline};
use tandem_board::SystemId;
use tandem_observers::{Event, Roles};

use tandem_watch::Picture;

/// The keys and their effect on the selected system.
const KEYS: &str = "Tab system p/o power off/on 0-2 kill core h hang c CAN b beats l link m mend q";

/// Names and colours of a system's states, in the order of the numbers of [`Roles::state`].
const STATES: [(&str, Color); 8] = [
    ("off", Color::DarkGray),
    ("starting", Color::Yellow),
    ("standby", Color::Cyan),
    ("MASTER", Color::Green),
    ("DEGRADED MASTER", Color::Magenta),
    ("SAFE STOP", Color::Red),
    ("suspended", Color::Red),
    ("PARKING", Color::Green),
];
/// Half of the displayed width of the lane, m: motorway lanes are 3.5 to 3.75 m wide.
const HALF_LANE_M: f64 = 1.85;
/// Half of the vehicle's width, m.
const HALF_VEHICLE_M: f64 = 0.9;
/// Upper end of the chart of gaps, ms.
const GAP_TOP_MS: f64 = 25.0;

/// What the screen shows beside the state of the run.
pub(super) struct Desk {
    /// The system that keys act on.
    pub(super) selected: SystemId,
    /// A description of the last action.
    pub(super) said: String,
}

/// Draws the screen.
pub(super) fn draw(picture: &Picture, desk: &Desk, frame: &mut Frame<'_>) {
    let areas = Layout::vertical([
        Constraint::Length(1),
        Constraint::Length(6),
        Constraint::Length(3),
        Constraint::Length(4),
        Constraint::Min(3),
        Constraint::Length(2),
    ]);
    let [head, systems, lane, gaps, events, foot] = areas.areas(frame.area());
    frame.render_widget(Paragraph::new(title(picture)), head);
    let halves = Layout::horizontal([Constraint::Fill(1), Constraint::Fill(1)]);
    let halves: [Rect; 2] = halves.areas(systems);
    for (system, area) in SystemId::ALL.into_iter().zip(halves) {
        draw_system(picture, desk, system, area, frame);
    }
    draw_lane(picture, lane, frame);
    draw_gaps(picture, gaps, frame);
    draw_events(picture, events, frame);
    let said = Span::styled(desk.said.as_str(), Style::new().fg(Color::Yellow));
    let keys = Span::styled(KEYS, Style::new().add_modifier(Modifier::DIM));
    frame.render_widget(Paragraph::new(vec![said.into(), keys.into()]), foot);
}

fn title(picture: &Picture) -> Line<'static> {
    let mut text = format!("{:30}", picture.run);
    if let Some(roles) = &picture.roles {
        let frames = picture.frames_per_s();
        text += &format!(" {:6.1}/{:.0} s", roles.time_s, roles.duration_s);
        text += &format!("  {frames:4} frames/s");
    }
    if let Some(vehicle) = &picture.vehicle {
        text += &format!("  {:3.0} km/h", vehicle.speed * 3.6);
        text += &match vehicle.lead_gap {
            gap if gap.is_nan() || gap > 999.0 => "  ahead free ".to_owned(),
            gap => format!("  ahead {gap:3.0} m"),
        };
    }
    let bold = Style::new().add_modifier(Modifier::BOLD);
    let ended = match picture.has_ended() {
        true => "  THE RUN HAS ENDED",
        false => "",
    };
    Line::from(vec![
        Span::styled(text, bold),
        Span::styled(ended, Style::new().fg(Color::Red)),
    ])
}

/// Returns a green lamp if `on`, a red one otherwise.
fn lamp(name: String, on: bool) -> [Span<'static>; 2] {
    let (sign, colour) = match on {
        true => ("● ", Color::Green),
        false => ("○ ", Color::Red),
    };
    [Span::raw(name), Span::styled(sign, Style::new().fg(colour))]
}

fn draw_system(
    picture: &Picture,
    desk: &Desk,
    system: SystemId,
    area: Rect,
    frame: &mut Frame<'_>,
) {
    let roles = picture.roles.unwrap_or(Roles {
        obeyed: u8::MAX,
        ..Roles::default()
    });
    let index = system.index();
    let state = usize::from(roles.state[index]);
    let (name, colour) = STATES.get(state).copied().unwrap_or(STATES[0]);
    let selected = match desk.selected == system {
        true => "►",
        false => " ",
    };
    let bold = Style::new().fg(colour).add_modifier(Modifier::BOLD);
    let title = Span::styled(format!("{selected}{system} {name} "), bold);
    let cores =
        [0, 1, 2].map(|core| lamp(format!("core {core} "), roles.alive[3 * index + core] != 0));
    let beats = [0, 1].map(|line| {
        lamp(
            format!("{} ", line + 1),
            roles.beats[index] >> line & 1 == 1,
        )
    });
    let mut beats_line = vec![Span::raw("heartbeats ")];
    beats_line.extend(beats.into_iter().flatten());
    let obeyed = match usize::from(roles.obeyed) == index {
        true => format!("the vehicle obeys it, term {}", roles.term),
        false => String::new(),
    };
    let lines = vec![
        Line::from(cores.into_iter().flatten().collect::<Vec<_>>()),
        Line::from(beats_line),
        Line::from(obeyed),
        Line::styled(cuts(&roles, system), Style::new().fg(Color::Red)),
    ];
    let block = Block::bordered().border_style(colour).title(title);
    frame.render_widget(Paragraph::new(lines).block(block), area);
}

/// Names the wires that start at this system and are cut; empty if none is.
fn cuts(roles: &Roles, system: SystemId) -> String {
    let mut text = String::new();
    for wire in roles.cut_wires(system.index()) {
        let lead = if text.is_empty() { "cut:" } else { "" };
        // All seven names fit into half of 80 columns.
        text += &format!("{lead} {}", wire.replace("heartbeat-", "beat"));
    }
    text
}

/// Draws the lane from above: its edges, its centre, and the vehicle.
fn draw_lane(picture: &Picture, area: Rect, frame: &mut Frame<'_>) {
    let width = usize::from(area.width.saturating_sub(2));
    let Some(vehicle) = picture.vehicle.filter(|_| width > 20) else {
        frame.render_widget(Paragraph::new("no vehicle yet"), area);
        return;
    };
    // The left side of the lane is on the left of the screen.
    let column = |left_m: f64| {
        let part = (HALF_LANE_M - left_m) / (2.0 * HALF_LANE_M);
        ((part * (width - 1) as f64)
            .round()
            .clamp(0.0, (width - 1) as f64)) as usize
    };
    let offset = vehicle.lateral_error;
    let (from, to) = (
        column(offset + HALF_VEHICLE_M),
        column(offset - HALF_VEHICLE_M),
    );
    let mut cells: Vec<char> = vec![' '; width];
    cells[column(0.0)] = '┊';
    cells[from..=to].fill('█');
    cells[0] = '║';
    cells[width - 1] = '║';
    let side = if offset >= 0.0 { "left" } else { "right" };
    let title = format!(
        " lane {}: {:.2} m {side} of its centre, lateral {:+.1} m/s², along {:+.1} m/s² ",
        vehicle.lane,
        offset.abs(),
        vehicle.lat_accel,
        vehicle.accel
    );
    let text: String = cells.into_iter().collect();
    let block = Block::bordered().title(title);
    let shown = Paragraph::new(text).style(Style::new().fg(Color::Blue));
    frame.render_widget(shown.block(block), area);
}

fn draw_gaps(picture: &Picture, area: Rect, frame: &mut Frame<'_>) {
    let roles = picture.roles.unwrap_or_default();
    let title = format!(
        " without control, up to {GAP_TOP_MS:.0} ms: max {:.1}, takeovers {}, last {:.1} ",
        roles.gap_max_ms, roles.takeovers, roles.takeover_gap_ms
    );
    let heights = picture.gaps_ms.iter().map(|ms| (ms * 10.0) as u64);
    let heights: Vec<u64> = heights.collect();
    let chart = Sparkline::default()
        .block(Block::bordered().title(title))
        .max((GAP_TOP_MS * 10.0) as u64)
        .style(Style::new().fg(Color::Yellow))
        .data(heights);
    frame.render_widget(chart, area);
}

fn draw_events(picture: &Picture, area: Rect, frame: &mut Frame<'_>) {
    let rows = usize::from(area.height.saturating_sub(2));
    let begin_ns = picture.begin_ns();
    let line = |event: &Event| {
        let at_s = event.at_ns.saturating_sub(begin_ns) as f64 * 1e-9;
        let system = if event.system == 0 { 'A' } else { 'B' };
        let part = event.part();
        Line::from(format!("{at_s:8.2} s  {system} {part:7}  {}", event.text()))
    };
    let newest = picture.events.iter().rev().take(rows).map(line);
    let block = Block::bordered().title(" events, the newest first ");
    let shown = Paragraph::new(newest.collect::<Vec<_>>()).block(block);
    frame.render_widget(shown, area);
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratatui::Terminal;
    use ratatui::backend::TestBackend;
    use ratatui::buffer::Buffer;
    use tandem_observers::{Frame as BusFrame, News, Vehicle};

    /// Returns the state of a run in which B has taken over from A 12 s after the start.
    fn picture() -> Picture {
        let mut picture = Picture::new("tandem-6796-62fc9754a45");
        let second = 1_000_000_000;
        for tenth in 0..70 {
            let at_ns = tenth * second / 10;
            for step in 0..10 {
                // One control frame is missing.
                let late = if (tenth, step) == (52, 4) {
                    8_000_000
                } else {
                    step % 3 * 100_000
                };
                let at_ns = at_ns + step * 10_000_000 + late;
                picture.take(&News::Frame(BusFrame::new(at_ns, 0x100, 2, 1, &[])));
            }
            picture.take(&News::Roles(Roles {
                at_ns: 53 * second + (tenth + 1) * second / 10,
                time_s: 14.2,
                duration_s: 60.0,
                gap_max_ms: 18.0,
                takeover_gap_ms: 18.0,
                takeovers: 1,
                term: 13,
                obeyed: 1,
                state: [1, 4],
                alive: [1, 0, 0, 1, 1, 1],
                beats: [0, 3],
                cuts: [0b110_0000, 0],
                ..Roles::default()
            }));
        }
        picture.take(&News::Vehicle(Vehicle {
            speed: 30.2,
            lateral_error: -0.21,
            lead_gap: 48.0,
            lane: 1,
            accel: -0.4,
            lat_accel: 0.1,
            ..Vehicle::default()
        }));
        for (at_s, system, core, text) in [
            (58.1, 0, 255, "core 0 died of signal 9"),
            (58.1, 0, 255, "resets the system: a core died"),
            (
                58.11,
                1,
                0,
                "takes over: power level fell and heartbeats ended, detected in 2.10 ms",
            ),
            (58.11, 1, 0, "is degraded master, term 13"),
            (58.3, 0, 0, "starts, incarnation 2: trap"),
        ] {
            let at_ns = (at_s * 1e9) as u64;
            picture.take(&News::Event(Event::new(at_ns, system, core, text)));
        }
        picture
    }

    fn desk() -> Desk {
        Desk {
            selected: SystemId::A,
            said: "kill core 0 of A".to_owned(),
        }
    }

    fn screen(picture: &Picture) -> Buffer {
        let mut terminal = Terminal::new(TestBackend::new(80, 24)).unwrap();
        terminal
            .draw(|frame| draw(picture, &desk(), frame))
            .unwrap();
        terminal.backend().buffer().clone()
    }

    fn rows(buffer: &Buffer) -> Vec<String> {
        let row = |y| (0..80).map(|x| buffer[(x, y)].symbol()).collect::<String>();
        (0..24).map(row).collect()
    }

    #[test]
    fn everything_fits_on_a_terminal_of_80_by_24() {
        let text = rows(&screen(&picture())).join("\n");
        for word in [
            "tandem-6796-62fc9754a45",
            "14.2/60 s",
            "109 km/h",
            "ahead  48 m",
            "►A starting",
            "B DEGRADED MASTER",
            "core 0 ● core 1 ○ core 2 ○",
            "heartbeats 1 ○ 2 ○",
            "obeys it, term 13",
            "cut: link can",
            "0.21 m right of its centre",
            "max 18.0, takeovers 1",
            "takes over: power level fell",
            "kill core 0 of A",
            "m mend q",
        ] {
            assert!(text.contains(word), "no {word:?} in\n{text}");
        }
    }

    /// The screen is drawn before the first message, and on a terminal of any size.
    #[test]
    fn a_run_without_news_and_a_tiny_terminal_are_drawn() {
        let empty = Picture::new("tandem-1-a");
        for (width, height) in [(80, 24), (20, 5), (1, 1), (200, 60)] {
            for picture in [&empty, &picture()] {
                let mut terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
                terminal
                    .draw(|frame| draw(picture, &desk(), frame))
                    .unwrap();
            }
        }
    }

    /// The picture in the documentation matches this screen. `UPDATE_DOCS=1` rewrites it.
    #[test]
    fn the_picture_in_the_docs_is_of_this_screen() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/top.svg");
        let svg = svg(&screen(&picture()));
        if std::env::var_os("UPDATE_DOCS").is_some() {
            std::fs::write(path, &svg).unwrap();
        }
        assert_eq!(std::fs::read_to_string(path).unwrap(), svg);
    }

    const fn css(colour: Color) -> &'static str {
        match colour {
            Color::Green => "#4caf50",
            Color::Red => "#ef5350",
            Color::Yellow => "#ffca28",
            Color::Cyan => "#26c6da",
            Color::Magenta => "#ec7bf0",
            Color::Blue => "#64b5f6",
            Color::DarkGray => "#888888",
            _ => "#dddddd",
        }
    }

    fn svg(buffer: &Buffer) -> String {
        let mut svg = "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 656 416\" \
            font-family=\"DejaVu Sans Mono, monospace\" font-size=\"13\" xml:space=\"preserve\">\n\
            <rect width=\"656\" height=\"416\" fill=\"#1b1b1b\"/>\n"
            .to_owned();
        for y in 0..24_u16 {
            for x in 0..80_u16 {
                let cell = &buffer[(x, y)];
                let symbol = cell.symbol();
                if symbol.trim().is_empty() {
                    continue;
                }
                let (left, base) = (8 + x * 8, 20 + y * 16);
                let colour = css(cell.fg);
                svg +=
                    &format!("<text x=\"{left}\" y=\"{base}\" fill=\"{colour}\">{symbol}</text>\n");
            }
        }
        svg + "</svg>\n"
    }
}
