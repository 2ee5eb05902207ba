//! `tandem topics echo`: the samples of a topic, or the frames of one message of the bus.

use std::io::Write;
use std::mem;

use serde_json::{Map, Value};
use tandem_board::Instant;
use tandem_bus::{FRAMES, Message};
use tandem_topics::endpoints::{INPUTS, OUTPUTS, SocTopic};
use tandem_topics::{
    CanFrame, CdrError, LateralControl, LongitudinalControl, ParkingBrake, PowerControl, TopicType,
};
use tandem_topics_host::gateway::{Gateway, Passed, content};
use tandem_topics_host::listing::Listing;
use tandem_topics_host::signals::SignalTable;

use super::tables::hex;
use super::{HINT_AFTER, Out, Watch, nothing, open, turn};
use crate::args::TopicsPlace;
use crate::failure::Failure;

/// What to print.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Wanted {
    /// All frames of the bus.
    Bus,
    /// The frames of one id.
    Frame(u32),
    /// A topic of the SoC.
    Command(SocTopic),
}

impl Wanted {
    fn parse(name: &str) -> Result<Self, Failure> {
        if name == OUTPUTS[0].topic {
            return Ok(Self::Bus);
        }
        let topics = SocTopic::ALL.into_iter().zip(&INPUTS);
        if let Some((topic, _)) = topics.clone().find(|(_, one)| one.topic == name) {
            return Ok(Self::Command(topic));
        }
        let frame = FRAMES
            .iter()
            .find(|info| info.name.eq_ignore_ascii_case(name));
        if let Some(info) = frame {
            return Ok(Self::Frame(info.id.into()));
        }
        let digits = name.strip_prefix("0x").or_else(|| name.strip_prefix("0X"));
        let id = digits.and_then(|digits| u32::from_str_radix(digits, 16).ok());
        if let Some(id) = id.filter(|id| *id < 1 << 29) {
            // Longer than three digits: an extended one.
            return Ok(Self::Frame(if id > 0x7FF { id | 1 << 31 } else { id }));
        }
        let topics: Vec<_> = OUTPUTS.iter().chain(&INPUTS).map(|one| one.topic).collect();
        let messages: Vec<_> = FRAMES.iter().map(|info| info.name).collect();
        Err(Failure::Usage(anyhow::anyhow!(
            "there is no topic or message {name:?}\n  topics: {}\n  messages: {}\n  or an id of \
             the bus: 0x110",
            topics.join(", "),
            messages.join(", ")
        )))
    }
}

pub(super) fn run(
    name: &str,
    place: &TopicsPlace,
    watch: &Watch<'_>,
    out: &mut Out<impl Write>,
) -> Result<(), Failure> {
    let wanted = Wanted::parse(name)?;
    let endpoint = match wanted {
        Wanted::Bus | Wanted::Frame(_) => OUTPUTS[0],
        Wanted::Command(topic) => INPUTS[topic as usize],
    };
    let mut node = open(place, &[endpoint])?;
    let mut listing = Listing::default();
    let mut printer = Printer {
        gateway: Gateway::default(),
        signals: SignalTable::new(),
        frames: 0,
    };
    let mut lines = mem::take(&mut out.json).lines();
    let (mut samples, mut has_hinted) = (0_u64, false);
    while !watch.is_over() && !out.is_closed {
        turn(&mut node, &mut listing)?;
        while let Some(sample) = node.take(0) {
            samples += 1;
            let line = match wanted {
                Wanted::Command(topic) => printer.command(node.now(), topic, sample.payload()),
                Wanted::Bus => printer.frame(node.now(), None, &sample),
                Wanted::Frame(id) => printer.frame(node.now(), Some(id), &sample),
            };
            if let Some((object, text)) = line {
                out.print(&lines.line(&object, || text)?)?;
            }
        }
        if printer.frames == 0 && !has_hinted && watch.begin.elapsed() > HINT_AFTER {
            has_hinted = true;
            eprintln!(
                "{}",
                silence(name, endpoint.topic, samples, place, &listing)
            );
        }
    }
    if printer.frames == 0 && !watch.is_interrupted() && !out.is_closed {
        let text = silence(name, endpoint.topic, samples, place, &listing);
        return Err(Failure::NothingHeard(text));
    }
    lines.finish()?;
    Ok(())
}

/// Says why nothing was printed.
fn silence(
    name: &str,
    topic: &str,
    samples: u64,
    place: &TopicsPlace,
    listing: &Listing,
) -> String {
    match samples {
        0 => nothing(place, Some(topic), listing),
        _ => format!("{samples} samples of {topic} were heard, and none of {name}"),
    }
}

struct Printer {
    gateway: Gateway,
    signals: SignalTable,
    /// How many lines it has made.
    frames: u64,
}

/// A line as JSON, and as text.
type Line = (Value, String);
/// A member with its value as text and unit, and as JSON.
type Member = (&'static str, String, Value);

impl Printer {
    fn frame(
        &mut self,
        now: Instant,
        wanted: Option<u32>,
        sample: &tandem_topics::Sample<{ tandem_topics_host::node::BYTES }>,
    ) -> Option<Line> {
        let frame = CanFrame::decode(sample.payload()).ok()?;
        let passed = self.gateway.hear(now, sample.writer, &frame)?;
        if wanted.is_some_and(|id| id != frame.id) {
            return None;
        }
        let data = content(&frame);
        let message = Message::decode(frame.id, data);
        let members: Vec<Member> = match &message {
            Ok(message) => self.signals.of(message).into_iter().map(member).collect(),
            Err(_) => {
                let hex: String = data.iter().map(|byte| format!("{byte:02X}")).collect();
                vec![("data", hex.clone(), hex.into())]
            }
        };
        let name = message.map_or("-", |message| message.frame().name);
        let mut head = Map::new();
        head.insert("id".to_owned(), hex(frame.id).into());
        head.insert("late".to_owned(), (passed == Passed::Late).into());
        let late = if passed == Passed::Late {
            "  (late)"
        } else {
            ""
        };
        let title = format!("{:>4} {name}{late}", hex(frame.id));
        Some(self.line(now, (name, &title), head, members))
    }

    fn command(&mut self, now: Instant, topic: SocTopic, payload: &[u8]) -> Option<Line> {
        let members = command_members(topic, payload).ok()?;
        let name = INPUTS[topic as usize].topic;
        Some(self.line(now, (name, name), Map::new(), members))
    }

    fn line(
        &mut self,
        now: Instant,
        (name, title): (&str, &str),
        mut object: Map<String, Value>,
        members: Vec<Member>,
    ) -> Line {
        self.frames += 1;
        let time_s = now.since(Instant::ORIGIN).as_ms_f64() / 1e3;
        let texts = members
            .iter()
            .map(|(name, text, _)| format!("  {name}={text}"));
        let text = format!("{time_s:10.4} {title}{}\n", texts.collect::<String>());
        let values = members.into_iter();
        let values: Map<_, _> = values
            .map(|(name, _, value)| (name.into(), value))
            .collect();
        object.insert("time_s".to_owned(), time_s.into());
        object.insert("name".to_owned(), name.into());
        object.insert("values".to_owned(), values.into());
        (Value::Object(object), text)
    }
}

fn member(signal: tandem_topics_host::signals::SignalValue) -> Member {
    let value = signal.value;
    let text = match signal.word {
        Some(word) => word.to_owned(),
        None => with_unit(value, signal.unit),
    };
    let value = match signal.word {
        Some(word) => word.into(),
        None => number(value),
    };
    (signal.name, text, value)
}

/// Returns a value with the shortest decimals of the precision in which it is computed.
fn decimals(value: f64) -> String {
    if value.fract() == 0.0 {
        format!("{value}")
    } else {
        format!("{}", value as f32)
    }
}

fn with_unit(value: f64, unit: &str) -> String {
    let space = if unit.is_empty() { "" } else { " " };
    format!("{}{space}{unit}", decimals(value))
}

/// Returns a value as JSON, with the same decimals.
fn number(value: f64) -> Value {
    let text = decimals(value);
    let whole = text.parse::<i64>().ok().map(Value::from);
    let number = || text.parse::<f64>().ok().map(Value::from);
    whole.or_else(number).unwrap_or_default()
}

/// Returns the members of a sample of the SoC.
fn command_members(topic: SocTopic, payload: &[u8]) -> Result<Vec<Member>, CdrError> {
    let value =
        |name, value: f32, unit| (name, with_unit(value.into(), unit), number(value.into()));
    let count = |value: u8| ("counter", value.to_string(), value.into());
    let flag = |value: bool| ("enable", value.to_string(), value.into());
    let word = |name, word: String| (name, word.clone(), word.into());
    Ok(match topic {
        SocTopic::Power => {
            let it = PowerControl::decode(payload)?;
            vec![
                count(it.counter),
                value("target_speed", it.target_speed, "m/s"),
                value("acceleration", it.acceleration, "m/s2"),
                value("distance", it.distance, "m"),
                word("target_gear", format!("{:?}", it.target_gear)),
            ]
        }
        SocTopic::Lateral => {
            let it = LateralControl::decode(payload)?;
            vec![
                count(it.counter),
                flag(it.enable),
                value("road_wheel_angle", it.road_wheel_angle, "rad"),
            ]
        }
        SocTopic::Longitudinal => {
            let it = LongitudinalControl::decode(payload)?;
            vec![
                count(it.counter),
                flag(it.enable),
                value("brake_torque", it.brake_torque, "Nm"),
                value("speed", it.speed, "m/s"),
            ]
        }
        SocTopic::ParkingBrake => {
            let it = ParkingBrake::decode(payload)?;
            vec![
                count(it.counter),
                word("request", format!("{:?}", it.request)),
            ]
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_topics_messages_and_ids() {
        assert_eq!(Wanted::parse("vehicle/can").unwrap(), Wanted::Bus);
        let power = Wanted::Command(SocTopic::Power);
        assert_eq!(Wanted::parse("soc/power").unwrap(), power);
        assert_eq!(Wanted::parse("egomotion").unwrap(), Wanted::Frame(0x110));
        assert_eq!(Wanted::parse("0x110").unwrap(), Wanted::Frame(0x110));
        assert_eq!(Wanted::parse("0x800").unwrap(), Wanted::Frame(0x8000_0800));
        for name in ["", "speed", "0x", "0x20000000", "soc"] {
            let Err(Failure::Usage(error)) = Wanted::parse(name) else {
                panic!("{name}");
            };
            let text = error.to_string();
            assert!(
                text.contains("soc/parking_brake") && text.contains("EgoMotion"),
                "{text}"
            );
        }
    }
}
