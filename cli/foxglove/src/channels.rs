//! The channels of a run, and what of its news becomes which message. docs/foxglove.md lists them.

use std::collections::BTreeMap;
use std::sync::Arc;

use foxglove::messages::{
    Event as FoxgloveEvent, FrameTransform, KeyValuePair, Log, PoseInFrame, SceneUpdate, log,
};
use foxglove::{Channel, Context, PartialMetadata, RawChannel, Schema};
use serde_json::{Value, json};
use tandem_board::Instant;
use tandem_bus::Message;
use tandem_observers::{Event, Frame, News, Roles, Vehicle};
use tandem_watch::{DrivingView, state_name};

use crate::scene;

/// The code of a ruling: the vehicle has accepted the frame.
const ACCEPTED: u8 = 1;
/// The identifier has 29 bits.
const EXTENDED: u8 = 1;

/// The channels of a run.
pub(crate) struct Channels {
    transform: Channel<FrameTransform>,
    pose: Channel<PoseInFrame>,
    ego: Channel<SceneUpdate>,
    tracks: Channel<SceneUpdate>,
    lanes: Channel<SceneUpdate>,
    trajectory: Channel<SceneUpdate>,
    log: Channel<Log>,
    events: Channel<FoxgloveEvent>,
    scene: Arc<RawChannel>,
    vehicle: Arc<RawChannel>,
    roles: Arc<RawChannel>,
    gaps: Arc<RawChannel>,
    driving: DrivingView,
    /// How much later UTC is than the clock of the run, ns; `None` before the first sample of a run
    /// in virtual time.
    ahead_ns: Option<u64>,
    /// When the last accepted control frame was on the bus, ns, and whose it was.
    last: Option<(u64, u8)>,
    states: [u8; 2],
    /// Time of the newest sample, ns.
    newest_ns: u64,
}

impl Channels {
    /// Creates the channels. This is done before clients connect: so each sees all channels at
    /// once.
    pub(crate) fn new(context: &Arc<Context>) -> Self {
        Self {
            transform: context.channel_builder("/tf").build(),
            pose: context.channel_builder("/vehicle/pose").build(),
            ego: context.channel_builder("/vehicle/body").build(),
            tracks: context.channel_builder("/tracks").build(),
            lanes: context.channel_builder("/lanes").build(),
            trajectory: context.channel_builder("/trajectory").build(),
            log: context.channel_builder("/log").build(),
            events: context.channel_builder("/events").build(),
            scene: figures(context, "/scene", &SCENE),
            vehicle: figures(context, "/vehicle", &VEHICLE),
            roles: figures(context, "/roles", &ROLES),
            gaps: figures(context, "/gaps", &GAPS),
            driving: DrivingView::new(),
            ahead_ns: None,
            last: None,
            states: [0; 2],
            newest_ns: 0,
        }
    }

    /// Sets how much later UTC is than the clock of the run. Otherwise the first sample is taken as
    /// new.
    pub(crate) const fn set_utc(&mut self, ahead_ns: Option<u64>) {
        self.ahead_ns = ahead_ns;
    }

    /// Passes on what a sample of the run says.
    pub(crate) fn take(&mut self, news: &News) {
        match news {
            News::Roles(roles) => self.roles(roles),
            News::Vehicle(vehicle) => self.vehicle(vehicle),
            News::Frame(frame) => self.frame(frame),
            News::Event(event) => self.event(event),
            News::Time(_) => {}
        }
    }

    /// Returns whether the run has published nothing yet.
    pub(crate) const fn is_empty(&self) -> bool {
        self.newest_ns == 0
    }

    /// Returns what the end of a file says of its making.
    pub(crate) fn figures(&self, lost: u64) -> BTreeMap<String, String> {
        let figures = [
            ("lost_samples", lost.to_string()),
            (
                "utc_ahead_of_run_ns",
                self.ahead_ns.unwrap_or(0).to_string(),
            ),
            ("tandem", env!("CARGO_PKG_VERSION").to_owned()),
        ];
        figures.map(|(key, value)| (key.to_owned(), value)).into()
    }

    /// Returns UTC at this time of the run, ns since 1970.
    fn utc(&mut self, at_ns: u64) -> u64 {
        self.newest_ns = self.newest_ns.max(at_ns);
        let now = || foxglove::messages::Timestamp::now().total_nanos();
        let ahead = *{ &mut self.ahead_ns }.get_or_insert_with(|| now().saturating_sub(at_ns));
        at_ns + ahead
    }

    fn vehicle(&mut self, now: &Vehicle) {
        let ns = self.utc(now.at_ns);
        let (x, y, heading) = (now.x, now.y, now.heading);
        let transform = scene::transform(ns, x, y, heading);
        self.transform.log_with_time(&transform, ns);
        let pose = scene::pose_on_map(ns, x, y, heading);
        self.pose.log_with_time(&pose, ns);
        self.ego.log_with_time(&scene::ego(ns), ns);
        let value = json!({
            "speed": now.speed,
            "acceleration": now.accel,
            "lateral_acceleration": now.lat_accel,
            "lane": now.lane,
            "lateral_error": now.lateral_error,
            "lead_gap": now.lead_gap.is_finite().then_some(now.lead_gap),
        });
        say(&self.vehicle, ns, value);
    }

    fn roles(&mut self, now: &Roles) {
        if now.at_ns == 0 {
            // No frame was on the bus yet.
            return;
        }
        let ns = self.utc(now.at_ns);
        let value = json!({
            "time": now.time_s,
            "a": state_name(now.state[0]),
            "b": state_name(now.state[1]),
            "obeyed": system(now.obeyed),
            "term": now.term,
            "takeovers": now.takeovers,
            "gap_max": now.gap_max_ms,
            "takeover_gap": now.takeover_gap_ms,
            "cores_alive": now.alive.iter().filter(|it| **it == 1).count(),
            "heartbeats_a": now.beats[0],
            "heartbeats_b": now.beats[1],
        });
        say(&self.roles, ns, value);
        for (index, (before, after)) in self.states.iter().zip(now.state).enumerate() {
            if *before != after {
                let what = [
                    ("event", "state".to_owned()),
                    ("system", system(index as u8).to_owned()),
                    ("from", state_name(*before).to_owned()),
                    ("to", state_name(after).to_owned()),
                ];
                self.events.log_with_time(&event(ns, ns, what), ns);
            }
        }
        self.states = now.state;
    }

    fn frame(&mut self, frame: &Frame) {
        let ns = self.utc(frame.at_ns);
        let data = frame.data.get(..frame.length.into());
        let (Some(data), 0) = (data, frame.flags & EXTENDED) else {
            return;
        };
        if frame.ruling == ACCEPTED
            && let Ok(Message::Control { system, control }) = Message::decode(frame.id, data)
        {
            self.gap(frame.at_ns, ns, system, control.term);
        }
        let at = Instant::from_ns(frame.at_ns);
        let Some((perceived, planned)) = self.driving.take(at, frame.id, data) else {
            return;
        };
        let tracks = scene::tracks(ns, &perceived);
        self.tracks.log_with_time(&tracks, ns);
        let lanes = scene::lanes(ns, perceived.lanes.as_ref());
        self.lanes.log_with_time(&lanes, ns);
        let way = scene::trajectory(ns, &planned);
        self.trajectory.log_with_time(&way, ns);
        let objects = perceived.objects.iter().map(|it| {
            json!({
                "id": it.id, "class": scene::class_name(it.class), "x": it.x, "y": it.y,
                "vx": it.vx, "vy": it.vy, "length": it.length, "width": it.width,
                "lane": it.lane, "cuts_in": it.cuts_in,
            })
        });
        let value = json!({
            "cycle": perceived.cycle,
            "speed": perceived.ego.speed,
            "yaw_rate": perceived.ego.yaw_rate,
            "set_speed": perceived.set_speed,
            "missing_sensors": perceived.missing,
            "maneuver": format!("{:?}", planned.maneuver),
            "objects": objects.collect::<Vec<_>>(),
        });
        say(&self.scene, ns, value);
    }

    /// Passes on the time between two accepted control frames.
    fn gap(&mut self, at_ns: u64, ns: u64, sender: u8, term: u32) {
        let Some((last_ns, last)) = self.last.replace((at_ns, sender)) else {
            return;
        };
        let gap_ns = at_ns.saturating_sub(last_ns);
        let gap_ms = gap_ns as f64 * 1e-6;
        let value = json!({ "gap": gap_ms, "system": system(sender), "term": term });
        say(&self.gaps, ns, value);
        if last != sender {
            let what = [
                ("event", "takeover".to_owned()),
                ("from", system(last).to_owned()),
                ("to", system(sender).to_owned()),
                ("term", term.to_string()),
                ("gap_ms", format!("{gap_ms:.2}")),
            ];
            let event = event(ns.saturating_sub(gap_ns), ns, what);
            self.events.log_with_time(&event, ns);
        }
    }

    fn event(&mut self, event: &Event) {
        let ns = self.utc(event.at_ns);
        let part = event.part();
        let message = Log {
            timestamp: Some(scene::timestamp(ns)),
            level: log::Level::Info.into(),
            message: event.text().to_owned(),
            name: format!("{} {part}", system(event.system)),
            ..Log::default()
        };
        self.log.log_with_time(&message, ns);
    }
}

fn system(code: u8) -> &'static str {
    match code {
        0 => "A",
        1 => "B",
        _ => "none",
    }
}

fn event<const N: usize>(from: u64, to: u64, what: [(&str, String); N]) -> FoxgloveEvent {
    let pair = |(key, value): (&str, String)| KeyValuePair {
        key: key.to_owned(),
        value,
    };
    FoxgloveEvent {
        start_time: Some(scene::timestamp(from)),
        end_time: Some(scene::timestamp(to)),
        metadata: what.map(pair).into(),
    }
}

/// Logs an object. Members without a value are absent: a schema has one type for each.
fn say(channel: &RawChannel, ns: u64, mut value: Value) {
    if channel.has_sinks() {
        if let Some(members) = value.as_object_mut() {
            members.retain(|_, it| !it.is_null());
        }
        let text = value.to_string();
        channel.log_with_meta(text.as_bytes(), PartialMetadata::with_log_time(ns));
    }
}

/// A channel of figures as JSON objects: the name of its schema, and each member with its type and
/// what it is.
struct Figures {
    schema: &'static str,
    members: Members,
}

type Members = &'static [(&'static str, &'static str, &'static str)];

/// Members of a track.
const OBJECT: Members = &[
    (
        "id",
        "integer",
        "stays the same as long as the object is tracked",
    ),
    ("class", "string", "kind of object"),
    ("x", "number", "centre, forward, m"),
    ("y", "number", "centre, left, m"),
    ("vx", "number", "velocity over ground, m/s"),
    ("vy", "number", "velocity over ground, m/s"),
    ("length", "number", "m"),
    ("width", "number", "m"),
    ("lane", "integer", "relative to the ego lane, left positive"),
    ("cuts_in", "boolean", "it moves into the ego lane"),
];

const VEHICLE: Figures = Figures {
    schema: "tandem.Vehicle",
    members: &[
        ("speed", "number", "m/s"),
        ("acceleration", "number", "longitudinal, m/s²"),
        ("lateral_acceleration", "number", "m/s²"),
        ("lane", "integer", "number of the lane"),
        (
            "lateral_error",
            "number",
            "from the lane's centre, left positive, m",
        ),
        (
            "lead_gap",
            "number",
            "to the vehicle ahead, m; absent without one",
        ),
    ],
};
const ROLES: Figures = Figures {
    schema: "tandem.Roles",
    members: &[
        ("time", "number", "scenario time, s"),
        ("a", "string", "state of system A"),
        ("b", "string", "state of system B"),
        ("obeyed", "string", "the system that the vehicle obeys"),
        ("term", "integer", "the term that the vehicle obeys"),
        ("takeovers", "integer", "changes of the obeyed system"),
        (
            "gap_max",
            "number",
            "longest time without control so far, ms",
        ),
        (
            "takeover_gap",
            "number",
            "the same at the last takeover, ms",
        ),
        (
            "cores_alive",
            "integer",
            "cores that have shown activity in the last 300 ms",
        ),
        (
            "heartbeats_a",
            "integer",
            "of A: bits of the lines that arrive",
        ),
        (
            "heartbeats_b",
            "integer",
            "of B: bits of the lines that arrive",
        ),
    ],
};
const GAPS: Figures = Figures {
    schema: "tandem.Gap",
    members: &[
        (
            "gap",
            "number",
            "time since the last accepted control frame, ms",
        ),
        ("system", "string", "the sender"),
        ("term", "integer", "its term"),
    ],
};
const SCENE: Figures = Figures {
    schema: "tandem.Scene",
    members: &[
        ("cycle", "integer", "counts the cycles of perception"),
        ("speed", "number", "m/s"),
        ("yaw_rate", "number", "rad/s"),
        (
            "set_speed",
            "number",
            "set by the driver, m/s; absent if not engaged",
        ),
        ("missing_sensors", "integer", "one bit for each sensor"),
        ("maneuver", "string", "the decision of planning"),
        (
            "objects",
            "array",
            "the confirmed tracks, nearest first; m and m/s",
        ),
    ],
};

/// Returns the JSON schema of an object with these members.
fn object(members: Members) -> Value {
    let members = members.iter().map(|(name, kind, text)| {
        let value = match *kind {
            "array" => json!({ "type": kind, "description": text, "items": object(OBJECT) }),
            _ => json!({ "type": kind, "description": text }),
        };
        ((*name).to_owned(), value)
    });
    let members: serde_json::Map<_, _> = members.collect();
    json!({ "type": "object", "properties": members })
}

fn figures(context: &Arc<Context>, topic: &str, of: &Figures) -> Arc<RawChannel> {
    let schema = object(of.members);
    let schema = Schema::new(of.schema, "jsonschema", schema.to_string().into_bytes());
    let builder = context.channel_builder(topic).message_encoding("json");
    #[allow(clippy::expect_used, reason = "the encoding, which it demands, is set")]
    builder.schema(schema).build_raw().expect("a channel")
}
