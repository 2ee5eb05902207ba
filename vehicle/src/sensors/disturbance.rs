//! The way from the sensors to the bus: the delay of each, and messages that are lost or late.

use std::collections::VecDeque;
use std::str::FromStr;

use tandem_bus::{Message, SensorId};

/// Delay of a late sensor's lists after the measurement, ms: a controller must not use them.
const LATE_MS: u64 = 400;

/// A sensor that fails, and when: written as `camera-front:lost:10-15` or `radar-front:late:10-15`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SensorFault {
    /// The sensor.
    pub sensor: SensorId,
    /// Whether its lists are sent late; otherwise they are lost.
    pub late: bool,
    /// Start and end in scenario time, s.
    pub span_s: (f64, f64),
}

/// The text is not a [`SensorFault`].
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("write it as camera-front:lost:10-15; sensors are {sensors}; lost or late", sensors = names())]
pub struct NoSensorFault;

/// Returns the name of a sensor on the command line: `radar-front-left`.
pub(super) fn name_of(sensor: SensorId) -> String {
    let mut name = String::new();
    for letter in sensor.name().chars() {
        if letter.is_ascii_uppercase() && !name.is_empty() {
            name.push('-');
        }
        name.push(letter.to_ascii_lowercase());
    }
    name
}

/// Returns the sensor with this name on the command line.
pub(super) fn named(name: &str) -> Option<SensorId> {
    let mut known = SensorId::ALL.into_iter();
    known.find(|sensor| name_of(*sensor) == name)
}

fn names() -> String {
    SensorId::ALL.map(name_of).join(", ")
}

impl FromStr for SensorFault {
    type Err = NoSensorFault;

    fn from_str(text: &str) -> Result<Self, NoSensorFault> {
        parsed(text).ok_or(NoSensorFault)
    }
}

fn parsed(text: &str) -> Option<SensorFault> {
    let (name, rest) = text.split_once(':')?;
    let (kind, span) = rest.split_once(':')?;
    let (from, to) = span.split_once('-')?;
    let seconds = |text: &str| text.trim_end_matches('s').parse::<f64>().ok();
    let (from, to) = (seconds(from)?, seconds(to)?);
    let late = match kind {
        "lost" => false,
        "late" => true,
        _ => return None,
    };
    let sensor = named(name)?;
    let is_span = (0.0..to).contains(&from) && to.is_finite();
    is_span.then_some(SensorFault {
        sensor,
        late,
        span_s: (from, to),
    })
}

/// The stage between the sensors and the bus: holds the faults and the delayed messages.
#[derive(Clone, Debug, Default)]
pub(crate) struct Outbox {
    faults: Vec<SensorFault>,
    /// Messages with the tick at which they are due, in order.
    held: VecDeque<(u64, Message)>,
    /// When the newest list of each sensor is due: no list overtakes an older one of its sensor.
    newest: [u64; SensorId::ALL.len()],
}

impl Outbox {
    pub(crate) fn set_faults(&mut self, faults: Vec<SensorFault>) {
        self.faults = faults;
    }

    /// Sends, holds back or drops messages of `sensor` at this tick and scenario time. `delay`: of
    /// the sensor, in ticks.
    pub(crate) fn pass(
        &mut self,
        (tick, time_s): (u64, f64),
        (sensor, delay): (SensorId, u64),
        messages: impl Iterator<Item = Message>,
        send: &mut dyn FnMut(&Message),
    ) {
        let fails = |fault: &&SensorFault| {
            fault.sensor == sensor && (fault.span_s.0..fault.span_s.1).contains(&time_s)
        };
        let due = tick + delay;
        match self.faults.iter().find(fails) {
            None => {
                let newest = &mut self.newest[sensor.index()];
                *newest = due.max(*newest);
                match *newest {
                    due if due <= tick => messages.for_each(|message| send(&message)),
                    due => self.hold(due, messages),
                }
            }
            Some(fault) if fault.late => self.hold(due + LATE_MS, messages),
            Some(_) => {}
        }
    }

    fn hold(&mut self, due: u64, messages: impl Iterator<Item = Message>) {
        let first = self.held.partition_point(|(at, _)| *at <= due);
        for (place, message) in (first..).zip(messages) {
            self.held.insert(place, (due, message));
        }
    }

    /// Returns whether a delayed message is due by this tick.
    pub(crate) fn is_due(&self, tick: u64) -> bool {
        self.held.front().is_some_and(|(due, _)| *due <= tick)
    }

    /// Sends the delayed messages that are due by this tick.
    pub(crate) fn release(&mut self, tick: u64, send: &mut dyn FnMut(&Message)) {
        let due = self.held.iter().take_while(|(due, _)| *due <= tick).count();
        for (_, message) in self.held.drain(..due) {
            send(&message);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_bus::{CameraLanes, SensorHeader};

    /// Lists arrive in the order in which they are due; no list overtakes one of its own sensor.
    #[test]
    fn delayed_lists_leave_in_order() {
        let list = |sensor, object_count| {
            let header = SensorHeader {
                object_count,
                ..SensorHeader::default()
            };
            let header = Message::SensorHeader(sensor, header);
            [header, Message::CameraLanes(CameraLanes::default())].into_iter()
        };
        let (mut outbox, mut sent) = (Outbox::default(), Vec::new());
        for tick in 0..200 {
            let mut send = |message: &Message| {
                if let Message::SensorHeader(_, header) = message {
                    sent.push((tick, header.object_count));
                }
            };
            outbox.release(tick, &mut send);
            let now = (tick, 0.0);
            let mut pass = |sensor, delay, number| {
                outbox.pass(now, (sensor, delay), list(sensor, number), &mut send);
            };
            match tick {
                10 => pass(SensorId::RadarFront, 60, 1),
                20 => pass(SensorId::CameraFront, 5, 2),
                60 => pass(SensorId::RadarFront, 1, 3),
                65 => pass(SensorId::CameraFront, 0, 4),
                75 => pass(SensorId::RadarFront, 0, 5),
                _ => {}
            }
        }
        assert_eq!(sent, [(25, 2), (65, 4), (70, 1), (70, 3), (75, 5)]);
    }

    #[test]
    fn faults_are_written_with_sensor_kind_and_time() {
        let fault = SensorFault {
            sensor: SensorId::RadarFrontLeft,
            late: true,
            span_s: (2.5, 10.0),
        };
        assert_eq!("radar-front-left:late:2.5-10s".parse(), Ok(fault));
        for text in [
            "",
            "camera-front",
            "camera:lost:1-2",
            "camera-front:gone:1-2",
            "camera-front:lost:2-1",
            "camera-front:lost:1-inf",
            "camera-front:lost:NaN-2",
            "camera-front:lost:1",
            "camera-front:lost:1-2:3",
        ] {
            assert_eq!(text.parse::<SensorFault>(), Err(NoSensorFault), "{text}");
        }
    }
}
