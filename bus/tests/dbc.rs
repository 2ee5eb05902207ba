//! This generator makes `src/dbc.rs` from `dbc/tandem.dbc`: an enum for each value table, a struct
//! for each frame layout, the enum of all messages and the table of all frames.
//! With `TANDEM_WRITE_DBC=1`, which `cargo xtask dbc` sets, it writes the file.
//!
//! Frames with the same layout share a struct (see [`Layout`]). The functions that the generated
//! code calls are in `src/signal.rs`. The generator fails on any unknown element in the DBC.

use std::collections::BTreeMap;
use std::error::Error;
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::Path;
use std::process::{Command, Stdio};
use std::{env, fs};

use can_dbc::{
    AttributeValue, ByteOrder, Comment, Dbc, Message, MessageId, MultiplexIndicator, NumericValue,
    Signal, ValDescription, ValueType,
};

/// Signals of the end-to-end protection: `src/e2e.rs` fills and checks them. A message whose
/// attribute `Protection` is `Own` has none of them; all its signals are values.
const PROTECTION: [&str; 2] = ["Crc", "Counter"];
/// The signal that names the sending system. Its value follows from the frame's id.
const SYSTEM: &str = "System";

type Result<T> = std::result::Result<T, Box<dyn Error>>;

#[test]
fn the_code_is_not_stale() -> Result<()> {
    let room = Path::new(env!("CARGO_MANIFEST_DIR"));
    let file = room.join("src/dbc.rs");
    let code = formatted(&generated(&fs::read_to_string(
        room.join("dbc/tandem.dbc"),
    )?)?)?;
    if env::var_os("TANDEM_WRITE_DBC").is_some() {
        return Ok(fs::write(&file, code)?);
    }
    assert!(
        fs::read_to_string(&file)? == code,
        "{} is stale: cargo xtask dbc",
        file.display()
    );
    Ok(())
}

/// A new message needs only its lines in the DBC: the generated code then has its struct, its value
/// table, its variant in [`Message`](tandem_bus::Message) with encoding and decoding, and its row
/// in the table of frames, which gives it its counters and its data id.
#[test]
fn one_more_message_needs_only_the_dbc() -> Result<()> {
    let room = Path::new(env!("CARGO_MANIFEST_DIR"));
    let text = fs::read_to_string(room.join("dbc/tandem.dbc"))?;
    let message = "BO_ 800 Weather: 8 Vehicle\n \
        SG_ Crc : 0|16@1+ (1,0) [0|65535] \"\" SystemA\n \
        SG_ Counter : 16|8@1+ (1,0) [0|255] \"\" SystemA\n \
        SG_ Rain : 24|2@1+ (1,0) [0|3] \"\" SystemA\n \
        SG_ OutsideTemperature : 32|16@1- (0.01,0) [-327.68|327.67] \"degC\" SystemA\n\n\
        CM_ BO_ 800 \"The weather\";\nCM_ \"The vehicle bus";
    let text = text.replacen("CM_ \"The vehicle bus", message, 1)
        + "BA_ \"GenMsgCycleTime\" BO_ 800 1000;\nVAL_ 800 Rain 0 \"Dry\" 1 \"Wet\" ;\n";
    let code = formatted(&generated(&text)?)?;
    let frames = tandem_bus::FRAMES.len();
    for line in [
        "    RainCode[2] { Dry = 0, Wet = 1 }",
        "    Weather[0x320] {",
        "        rain: RainCode = RAIN(\"Rain\", 24, 2, 0..=3),",
        "    /// The weather.\n    Weather(Weather),",
        &format!("            Self::Weather(_) => {frames},"),
        "            0x320 => Self::Weather(Weather::default()),",
        "            Self::Weather(weather) => weather.walk(walk),",
        &format!("pub const FRAMES: [FrameInfo; {}] = [", frames + 1),
        "    FrameInfo::new(0x320, \"Weather\", 8, 1000),",
    ] {
        assert!(code.contains(&format!("{line}\n")), "no {line:?}");
    }
    Ok(())
}

/// Returns the code as `cargo fmt` formats it.
fn formatted(code: &str) -> Result<String> {
    let mut rustfmt = Command::new("rustfmt")
        .args(["--edition", "2024"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .map_err(|error| format!("rustfmt: {error}; rustup component add rustfmt"))?;
    let mut input = rustfmt.stdin.take().ok_or("no pipe to rustfmt")?;
    input.write_all(code.as_bytes())?;
    drop(input);
    Ok(String::from_utf8(rustfmt.wait_with_output()?.stdout)?)
}

fn generated(text: &str) -> Result<String> {
    let dbc = Dbc::try_from(text).map_err(|e| format!("the DBC: {e}"))?;
    for message in &dbc.messages {
        check_protection(&dbc, message)?;
    }
    let sensors = sensors(&dbc);
    let layouts = layouts(&dbc, &sensors)?;

    let mut out =
        "//! Enums, structs, messages and frames of `dbc/tandem.dbc`. Made by `cargo xtask \
                   dbc`: not to be edited.\n\nuse crate::signal::{FrameError, FrameInfo, Signal, \
                   Walk, layouts, value_tables};\n\n"
            .to_owned();
    write_sensors(&dbc, &sensors, &mut out)?;
    write_value_tables(&dbc, &mut out)?;
    out += "layouts! {\n";
    for layout in &layouts {
        write_layout(&dbc, layout, &mut out)?;
    }
    out += "}\n\n";
    write_messages(&dbc, &layouts, &sensors, &mut out)?;
    write_frames(&dbc, &mut out)?;
    Ok(out)
}

/// The senders of the frames of a layout.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Senders {
    /// One node sends one frame.
    One,
    /// Both systems, each under its own id.
    Systems,
    /// Every sensor, each under its own id.
    Sensors,
}

/// The frames that share a struct: `ControlA` of `SystemA` and `ControlB` of `SystemB` share
/// `Control`, the `<Sensor>Header` of all sensors share `SensorHeader`; others share none.
struct Layout<'a> {
    name: String,
    senders: Senders,
    messages: Vec<&'a Message>,
}

impl Layout<'_> {
    fn has_system(&self) -> bool {
        let signals = &self.messages[0].signals;
        signals.iter().any(|signal| signal.name == SYSTEM)
    }

    /// Returns the pattern of a message of this layout, with these names for its parts.
    fn pattern(&self, sender: &str, values: &str) -> String {
        let name = &self.name;
        let field = snake(name);
        let part = |name: &str, value: &str| match value {
            "_" => String::new(),
            _ if name == value => format!("{name}, "),
            _ => format!("{name}: {value}, "),
        };
        match self.senders {
            Senders::One => format!("{name}({values})"),
            Senders::Sensors => format!("{name}({sender}, {values})"),
            Senders::Systems => {
                let (system, values) = (part("system", sender), part(&field, values));
                let rest = if system.is_empty() || values.is_empty() {
                    ".."
                } else {
                    ""
                };
                format!("{name} {{ {system}{values}{rest} }}")
            }
        }
    }
}

fn node(message: &Message) -> &str {
    message.transmitter.as_deref().unwrap_or_default()
}

/// Returns the nodes that send object lists, in the order of the DBC.
fn sensors(dbc: &Dbc) -> Vec<&str> {
    let begins_list = |message: &&Message| message.name == format!("{}Header", node(message));
    dbc.messages.iter().filter(begins_list).map(node).collect()
}

/// Returns the layouts, ordered by the place of their first frame in the DBC.
fn layouts<'a>(dbc: &'a Dbc, sensors: &[&str]) -> Result<Vec<Layout<'a>>> {
    let mut layouts: Vec<Layout<'a>> = Vec::new();
    for message in &dbc.messages {
        let of_system = node(message)
            .strip_prefix("System")
            .and_then(|letter| message.name.strip_suffix(letter));
        let of_sensor = message.name.strip_prefix(node(message)).filter(|rest| {
            let sends = |sensor: &&str| {
                let name = format!("{sensor}{rest}");
                dbc.messages.iter().any(|message| message.name == name)
            };
            !sensors.is_empty() && sensors.iter().all(sends)
        });
        let (name, senders) = match (of_system, of_sensor) {
            (Some(base), _) => (base.to_owned(), Senders::Systems),
            (None, Some(rest)) => (format!("Sensor{rest}"), Senders::Sensors),
            (None, None) => (message.name.clone(), Senders::One),
        };
        match layouts.iter_mut().find(|layout| layout.name == name) {
            Some(layout) => {
                check_same_layout(layout.messages[0], message)?;
                layout.messages.push(message);
            }
            None => layouts.push(Layout {
                name,
                senders,
                messages: vec![message],
            }),
        }
    }
    for layout in &layouts {
        let expected = match layout.senders {
            Senders::One => 1,
            Senders::Systems => 2,
            Senders::Sensors => sensors.len(),
        };
        if layout.messages.len() != expected {
            return Err(format!("{}: not one frame for each sender", layout.name).into());
        }
    }
    Ok(layouts)
}

/// Returns whether `src/e2e.rs` protects a message.
fn has_e2e(dbc: &Dbc, message: &Message) -> bool {
    let own = dbc.resolved_message_attribute(message.id, "Protection");
    !matches!(own, Some(AttributeValue::Uint(1) | AttributeValue::Int(1)))
}

/// Checks that the signals of the end-to-end protection are where `src/e2e.rs` expects them, or
/// that a message with a protection of its own has none of them.
fn check_protection(dbc: &Dbc, message: &Message) -> Result<()> {
    for (name, start_bit, size) in [("Crc", 0, 16), ("Counter", 16, 8)] {
        let found = message.signals.iter().find(|s| s.name == name);
        if !has_e2e(dbc, message) {
            if found.is_some() {
                return Err(
                    format!("{}: {name} beside a protection of its own", message.name).into(),
                );
            }
            continue;
        }
        if !found.is_some_and(|s| s.start_bit == start_bit && s.size == size) {
            return Err(format!("{}: {name} must be {start_bit}|{size}", message.name).into());
        }
    }
    Ok(())
}

fn check_same_layout(first: &Message, other: &Message) -> Result<()> {
    let bare = |message: &Message| -> Vec<Signal> {
        let without_receivers = |s: &Signal| Signal {
            receivers: Vec::new(),
            ..s.clone()
        };
        message.signals.iter().map(without_receivers).collect()
    };
    if first.size != other.size || bare(first) != bare(other) {
        return Err(format!(
            "{} and {} must have the same layout",
            first.name, other.name
        )
        .into());
    }
    Ok(())
}

fn write_sensors(dbc: &Dbc, sensors: &[&str], out: &mut String) -> Result<()> {
    let mut variants = String::new();
    for sensor in sensors {
        let comment = dbc.comments.iter().find_map(|comment| match comment {
            Comment::Node { name, comment } if name == sensor => Some(comment.as_str()),
            _ => None,
        });
        let comment = comment.unwrap_or("Sensor");
        writeln!(variants, "    /// {comment}.\n    {sensor},")?;
    }
    let names: String = sensors
        .iter()
        .map(|sensor| format!("            Self::{sensor} => \"{sensor}\",\n"))
        .collect();
    write!(
        out,
        r#"/// A sensor that sends object lists.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum SensorId {{
{variants}}}

impl SensorId {{
    /// Every sensor, in the order of the DBC.
    pub const ALL: [Self; {count}] = [{all}];

    /// Name of the sensor's node in the DBC.
    #[must_use]
    pub const fn name(self) -> &'static str {{
        match self {{
{names}        }}
    }}
}}

"#,
        count = sensors.len(),
        all = sensors
            .iter()
            .map(|sensor| format!("Self::{sensor}, "))
            .collect::<String>(),
    )?;
    Ok(())
}

/// Writes one enum for each signal name with a value table; equal names must have equal tables.
fn write_value_tables(dbc: &Dbc, out: &mut String) -> Result<()> {
    let mut tables: BTreeMap<&str, &[ValDescription]> = BTreeMap::new();
    for message in &dbc.messages {
        for signal in &message.signals {
            let Some(table) = dbc.value_descriptions_for_signal(message.id, &signal.name) else {
                continue;
            };
            let known = tables.entry(&signal.name).or_insert(table);
            if *known != table {
                return Err(format!("the value tables of {} differ", signal.name).into());
            }
        }
    }
    *out += "value_tables! {\n";
    for (signal, table) in tables {
        let values = table
            .iter()
            .map(|ValDescription { id, description }| format!("{description} = {id}"));
        let values: Vec<String> = values.collect();
        let (name, count, values) = (code_name(signal), table.len(), values.join(", "));
        writeln!(
            out,
            "    /// Values of the signal `{signal}`.\n    {name}[{count}] {{ {values} }}"
        )?;
    }
    *out += "}\n\n";
    Ok(())
}

/// Returns the name of the enum of a signal with a value table.
fn code_name(signal: &str) -> String {
    format!("{signal}Code")
}

fn write_layout(dbc: &Dbc, layout: &Layout<'_>, out: &mut String) -> Result<()> {
    let Layout { name, messages, .. } = layout;
    let message = messages[0];
    let fields: Vec<Field> = message
        .signals
        .iter()
        .filter(|signal| !PROTECTION.contains(&&*signal.name) && signal.name != SYSTEM)
        .map(|signal| Field::of(dbc, message, signal))
        .collect::<Result<_>>()?;
    let comment = comment(dbc, message).map(|comment| format!("    /// {comment}.\n    ///\n"));
    let comment = comment.unwrap_or_default();
    let names: Vec<String> = messages.iter().map(|m| format!("`{}`", m.name)).collect();
    let names = names.join(", ");
    let ids: Result<Vec<String>> = messages.iter().map(|m| standard_id(m)).collect();
    let ids = ids?.join(", ");
    writeln!(
        out,
        "{comment}    /// Layout of {names}.\n    {name}[{ids}] {{"
    )?;
    for Field {
        name,
        doc,
        rust,
        signal,
    } in &fields
    {
        writeln!(out, "        /// {doc}\n        {name}: {rust} = {signal},")?;
    }
    *out += "    }\n";
    Ok(())
}

/// Returns the comment of a message, for all frames with its layout.
fn comment(dbc: &Dbc, message: &Message) -> Option<String> {
    let comment = dbc.message_comment(message.id)?;
    let comment = comment.replace(" of system A", "");
    Some(comment.trim_end_matches('.').to_owned())
}

/// Writes the enum of all messages.
fn write_messages(
    dbc: &Dbc,
    layouts: &[Layout<'_>],
    sensors: &[&str],
    out: &mut String,
) -> Result<()> {
    let place = |message: &Message| dbc.messages.iter().position(|one| one.id == message.id);
    let (mut variants, mut indices) = (String::new(), String::new());
    let (mut blanks, mut walks) = (String::new(), String::new());
    for layout in layouts {
        let Layout { name, messages, .. } = layout;
        let comment = comment(dbc, messages[0]).unwrap_or_default();
        let comment = comment.split(['.', ';', ':']).next().unwrap_or_default();
        let variant = match layout.senders {
            Senders::One => format!("{name}({name})"),
            Senders::Sensors => format!("{name}(SensorId, {name})"),
            Senders::Systems => format!(
                "{name} {{ /// 0 = A, 1 = B.\n system: u8, /// The values.\n {}: {name} }}",
                snake(name)
            ),
        };
        writeln!(variants, "    /// {comment}.\n    {variant},")?;

        let places: Vec<String> = messages
            .iter()
            .map(|message| Ok(place(message).ok_or("a place")?.to_string()))
            .collect::<Result<_>>()?;
        let (sender, index) = match layout.senders {
            Senders::One => ("_", places[0].clone()),
            Senders::Sensors => ("sensor", format!("[{}][sensor.index()]", places.join(", "))),
            Senders::Systems => (
                "system",
                format!("[{}][(*system != 0) as usize]", places.join(", ")),
            ),
        };
        writeln!(
            indices,
            "            Self::{} => {index},",
            layout.pattern(sender, "_")
        )?;

        for (number, message) in messages.iter().enumerate() {
            let sender = match layout.senders {
                Senders::One => String::new(),
                Senders::Sensors => format!("SensorId::{}", sensors[number]),
                Senders::Systems => number.to_string(),
            };
            let blank = layout.pattern(&sender, &format!("{name}::default()"));
            writeln!(
                blanks,
                "            {} => Self::{blank},",
                standard_id(message)?
            )?;
        }

        let sender = if layout.has_system() { "system" } else { "_" };
        let pattern = layout.pattern(sender, &snake(name));
        let walk = format!("{}.walk(walk)", snake(name));
        let implied = messages[0].signals.iter().find(|it| it.name == SYSTEM);
        let walk = match implied {
            Some(signal) => {
                let place = signal_place(messages[0], signal)?;
                format!("{{ walk.implied(&const {{ Signal::new({place}) }}, *system)?; {walk} }}")
            }
            None => walk,
        };
        writeln!(walks, "            Self::{pattern} => {walk},")?;
    }
    write!(
        out,
        r"/// A frame of the vehicle bus with its values. `system` is 0 for A and 1 for B; a greater one
/// saturates to 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Message {{
{variants}}}

impl Message {{
    /// Place of its frame in [`FRAMES`].
    pub(crate) const fn index(&self) -> usize {{
        match self {{
{indices}        }}
    }}

    /// The message of the frame with this id, with default values.
    #[inline(always)]
    pub(crate) fn blank(id: u16) -> Option<Self> {{
        Some(match id {{
{blanks}            _ => return None,
        }})
    }}

    pub(crate) fn walk(&mut self, walk: &mut impl Walk) -> Result<(), FrameError> {{
        match self {{
{walks}        }}
    }}
}}

"
    )?;
    Ok(())
}

fn write_frames(dbc: &Dbc, out: &mut String) -> Result<()> {
    let count = dbc.messages.len();
    writeln!(
        out,
        "/// Every frame of the vehicle bus, in the order of the DBC, which is by id.\n\
         pub const FRAMES: [FrameInfo; {count}] = ["
    )?;
    for message in &dbc.messages {
        let Message { name, size, .. } = message;
        let (id, cycle) = (standard_id(message)?, cycle_ms(dbc, message.id)?);
        let protection = if has_e2e(dbc, message) {
            ""
        } else {
            ".without_e2e()"
        };
        writeln!(
            out,
            "    FrameInfo::new({id}, \"{name}\", {size}, {cycle}){protection},"
        )?;
    }
    writeln!(out, "];")?;
    Ok(())
}

/// A signal as a field of its struct.
struct Field {
    name: String,
    doc: String,
    /// Its type.
    rust: String,
    /// Its constant, with the place and range of the signal.
    signal: String,
}

impl Field {
    fn of(dbc: &Dbc, message: &Message, signal: &Signal) -> Result<Self> {
        let Signal {
            name,
            min,
            max,
            factor,
            unit,
            ..
        } = signal;
        let comment = dbc.signal_comment(message.id, name);
        let mut doc = comment.map_or(format!("Signal `{name}`"), str::to_owned) + ".";
        let has_table = dbc
            .value_descriptions_for_signal(message.id, name)
            .is_some();
        let rust = if has_table {
            code_name(name)
        } else if *factor != 1.0 || signal.value_type == ValueType::Signed {
            if signal.size > 24 {
                return Err(format!("{name}: an f32 has only 24 bits").into());
            }
            write!(doc, " {min} ..= {max} {unit} in steps of {factor}")?;
            "f32".to_owned()
        } else {
            if signal.size > 1 {
                write!(doc, " {min} ..= {max} {unit}")?;
            }
            let rust = match signal.size {
                1 => "bool",
                2..=8 => "u8",
                9..=16 => "u16",
                _ => "u32",
            };
            rust.to_owned()
        };
        Ok(Self {
            name: snake(name),
            doc,
            rust,
            signal: format!(
                "{}({}){}",
                shouted(name),
                signal_place(message, signal)?,
                match signal.byte_order {
                    ByteOrder::LittleEndian => "",
                    ByteOrder::BigEndian => ".big_endian()",
                }
            ),
        })
    }
}

/// Returns the first bit of a signal for `Signal::new`; `None` if the signal is big endian and does
/// not fill whole bytes. The DBC gives the highest bit of a big endian signal.
fn first_bit(signal: &Signal) -> Option<u64> {
    let is_whole_bytes = signal.start_bit % 8 == 7 && signal.size.is_multiple_of(8);
    match signal.byte_order {
        ByteOrder::LittleEndian => Some(signal.start_bit),
        ByteOrder::BigEndian if !is_whole_bytes => None,
        ByteOrder::BigEndian => Some(signal.start_bit - 7),
    }
}

/// Returns the arguments of `Signal::new` in `src/signal.rs` for a signal.
fn signal_place(message: &Message, signal: &Signal) -> Result<String> {
    let Signal {
        name, size, factor, ..
    } = signal;
    let start_bit = first_bit(signal).filter(|start_bit| {
        signal.multiplexer_indicator == MultiplexIndicator::Plain
            && signal.offset == 0.0
            && *size <= 32
            && start_bit + size <= message.size * 8
    });
    let start_bit = start_bit.ok_or_else(|| {
        format!("{name}: not a plain signal within the frame, up to 32 bits, or whole bytes")
    })?;
    let raw = |physical: &NumericValue| (number(physical) / factor).round() as i64;
    let (min, max) = (raw(&signal.min), raw(&signal.max));
    let held = match signal.value_type {
        ValueType::Unsigned => 0..1 << size,
        ValueType::Signed => -(1 << (size - 1))..1 << (size - 1),
    };
    if !held.contains(&min) || !held.contains(&max) || min > max {
        return Err(format!("{name}: {size} bits do not hold its range").into());
    }
    let steps = match *factor {
        1.0 => String::new(),
        factor => format!("; {factor:?}"),
    };
    Ok(format!(
        "\"{name}\", {start_bit}, {size}, {min}..={max}{steps}"
    ))
}

fn standard_id(message: &Message) -> Result<String> {
    match message.id {
        MessageId::Standard(id) if id <= 0x7FF => Ok(format!("{id:#05X}")),
        id => Err(format!("{}: {id:?} is not a standard id", message.name).into()),
    }
}

fn cycle_ms(dbc: &Dbc, id: MessageId) -> Result<i64> {
    match dbc.resolved_message_attribute(id, "GenMsgCycleTime") {
        Some(AttributeValue::Uint(ms)) => Ok(i64::try_from(*ms)?),
        Some(AttributeValue::Int(ms)) => Ok(*ms),
        other => Err(format!("{id:?}: the cycle time is {other:?}").into()),
    }
}

fn number(value: &NumericValue) -> f64 {
    match *value {
        NumericValue::Uint(v) => v as f64,
        NumericValue::Int(v) => v as f64,
        NumericValue::Double(v) => v,
    }
}

/// Converts `SteeringAngle` to `steering_angle`, `VX` to `vx`, `XDeviation` to `x_deviation`.
fn snake(camel: &str) -> String {
    let letters: Vec<char> = camel.chars().collect();
    let mut out = String::new();
    for (i, c) in letters.iter().enumerate() {
        let ends_word = i > 0 && !letters[i - 1].is_uppercase();
        let ends_capitals = i > 0 && letters.get(i + 1).is_some_and(|next| next.is_lowercase());
        if c.is_uppercase() && (ends_word || ends_capitals) {
            out.push('_');
        }
        out.extend(c.to_lowercase());
    }
    out
}

fn shouted(camel: &str) -> String {
    snake(camel).to_uppercase()
}
