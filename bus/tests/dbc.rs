//! `src/dbc.rs` is what this generator makes of `dbc/tandem.dbc`: structs for frame layouts, enums
//! for value tables. `TANDEM_WRITE_DBC=1` writes it, as `cargo xtask dbc` does.
//!
//! Frames with the same layout share a struct (see [`layout_name`]). What the generated code calls
//! stands in `src/signal.rs`. The generator fails at anything in the DBC that it does not know.

use std::collections::BTreeMap;
use std::error::Error;
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::Path;
use std::process::{Command, Stdio};
use std::{env, fs};

use can_dbc::{
    AttributeValue, ByteOrder, Dbc, Message, MessageId, MultiplexIndicator, NumericValue, Signal,
    ValDescription, ValueType,
};

/// Signals that the message layer fills and checks; they are no fields of the structs.
const FRAMING: [&str; 3] = ["Crc", "Counter", "System"];

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

/// As `cargo fmt` would have it.
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
    let dbc = Dbc::try_from(text).map_err(|e| format!("tandem.dbc: {e}"))?;

    // Structs appear in the order in which their first message stands in the DBC.
    let mut layouts: Vec<(String, Vec<&Message>)> = Vec::new();
    for message in &dbc.messages {
        check_protection(message)?;
        let name = layout_name(message);
        match layouts.iter_mut().find(|(n, _)| *n == name) {
            Some((_, messages)) => {
                check_same_layout(messages[0], message)?;
                messages.push(message);
            }
            None => layouts.push((name, vec![message])),
        }
    }

    let mut out = "//! The structs, enums and ids of `dbc/tandem.dbc`. Made by `cargo xtask dbc`: not \
                   to be edited.\n\nuse crate::DecodeError;\nuse crate::signal::{FrameInfo, Signal};\n\n"
        .to_owned();
    write_enums(&dbc, &mut out)?;
    for (name, messages) in &layouts {
        write_layout(&dbc, name, messages, &mut out)?;
    }
    write_frames(&dbc, &mut out)?;
    Ok(out)
}

/// The struct that codes a message: `ControlA` of `SystemA` → `Control`, `CameraFrontHeader` of
/// `CameraFront` → `SensorHeader`, any other by its own name.
fn layout_name(message: &Message) -> String {
    let sender = message.transmitter.as_deref().unwrap_or_default();
    if let Some(rest) = message.name.strip_prefix(sender) {
        return format!("Sensor{rest}");
    }
    match sender
        .strip_prefix("System")
        .and_then(|letter| message.name.strip_suffix(letter))
    {
        Some(base) => base.to_owned(),
        None => message.name.clone(),
    }
}

/// Checks that the signals of the end-to-end protection are where `src/e2e.rs` expects them.
fn check_protection(message: &Message) -> Result<()> {
    for (name, start_bit, size) in [("Crc", 0, 16), ("Counter", 16, 8)] {
        let found = message.signals.iter().find(|s| s.name == name);
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

/// One enum per signal name with a value table; tables of the same name must be the same.
fn write_enums(dbc: &Dbc, out: &mut String) -> Result<()> {
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
    for (name, table) in tables {
        let lines = |line: &dyn Fn(&ValDescription) -> String| -> String {
            table.iter().map(|value| line(value) + "\n").collect()
        };
        let first = table.first().map(|value| value.id);
        let variants = lines(&|ValDescription { id, description }| {
            let default = if Some(*id) == first {
                "#[default] "
            } else {
                ""
            };
            format!("    /// Coded as {id}.\n    {default}{description} = {id},")
        });
        let all = lines(&|value| format!("        Self::{},", value.description));
        let names = lines(&|ValDescription { description, .. }| {
            format!("            Self::{description} => \"{description}\",")
        });
        let count = table.len();
        write!(
            out,
            r"/// Values of the signal `{name}`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum {name} {{
{variants}}}

impl {name} {{
    /// Every value, in the order of the DBC.
    pub const ALL: [Self; {count}] = [
{all}    ];

    /// The value's name in the DBC.
    #[must_use]
    pub const fn name(self) -> &'static str {{
        match self {{
{names}        }}
    }}

    fn from_raw(raw: i64) -> Option<Self> {{
        Self::ALL.into_iter().find(|value| *value as i64 == raw)
    }}
}}

"
        )?;
    }
    Ok(())
}

fn write_layout(dbc: &Dbc, name: &str, messages: &[&Message], out: &mut String) -> Result<()> {
    let message = messages[0];
    let fields: Vec<Field<'_>> = message
        .signals
        .iter()
        .filter(|signal| !FRAMING.contains(&signal.name.as_str()))
        .map(|signal| Field::of(dbc, message, signal))
        .collect::<Result<_>>()?;

    let lines = |line: &dyn Fn(&Field<'_>) -> String| -> String {
        fields.iter().map(|field| line(field) + "\n").collect()
    };
    let comment = dbc.message_comment(message.id).map(|comment| {
        let comment = comment.replace(" of system A", "");
        format!("/// {}.\n///\n", comment.trim_end_matches('.'))
    });
    let names: Vec<String> = messages.iter().map(|m| format!("`{}`", m.name)).collect();
    let ids: Vec<String> = messages
        .iter()
        .map(|m| standard_id(m))
        .collect::<Result<_>>()?;
    let only_id = match ids.as_slice() {
        [id] => format!("    /// Id of the frame.\n    pub const ID: u16 = {id};\n"),
        _ => String::new(),
    };
    write!(
        out,
        r"{comment}/// Layout of {names}.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct {name} {{
{members}}}

impl {name} {{
    /// Ids of the frames with this layout, in the order of the DBC.
    pub const IDS: [u16; {count}] = [{ids}];
{only_id}    /// Length of the frame, bytes.
    pub const LEN: usize = {len};
    /// Period of the frame, ms.
    pub const CYCLE_MS: u32 = {cycle};

{signals}
    /// Writes all signals except the end-to-end protection, whose bytes become zero. Values out of
    /// range saturate, fractions round to nearest, NaN becomes 0.
    pub fn encode(&self, data: &mut [u8; Self::LEN]) {{
        *data = [0; Self::LEN];
{puts}    }}

    /// Reads the signals. The end-to-end protection is not checked.
    ///
    /// # Errors
    /// [`DecodeError::WrongLength`], or [`DecodeError::InvalidSignal`] for a value
    /// that is out of the signal's range or not in its value table.
    pub fn decode(data: &[u8]) -> Result<Self, DecodeError> {{
        if data.len() != Self::LEN {{
            return Err(DecodeError::WrongLength);
        }}
        Ok(Self {{
{gets}        }})
    }}

    /// The values by their names in the DBC: physical ones, flags and tables as numbers.
    #[must_use]
    pub fn values(&self) -> [(&'static str, f64); {fields}] {{
        [
{values}        ]
    }}
}}

",
        comment = comment.unwrap_or_default(),
        names = names.join(", "),
        members = lines(&|field| {
            let (doc, name) = (&field.doc, &field.name);
            format!("    /// {doc}\n    pub {name}: {},", field.kind.rust())
        }),
        count = ids.len(),
        ids = ids.join(", "),
        len = message.size,
        cycle = cycle_ms(dbc, message.id)?,
        signals = signal_consts(message)?,
        puts = lines(&|field| format!("        Self::{};", field.put())),
        gets = lines(&|field| format!("            {}: {},", field.name, field.get())),
        fields = fields.len(),
        values = lines(&|field| format!("            {},", field.value())),
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
        writeln!(
            out,
            "    FrameInfo {{ id: {id}, name: \"{name}\", len: {size}, cycle_ms: {cycle} }},"
        )?;
    }
    writeln!(out, "];")?;
    Ok(())
}

/// How a signal appears in Rust.
enum Kind<'a> {
    /// One bit.
    Flag,
    /// Unsigned with factor 1: the Rust type.
    Integer(&'static str),
    /// With a value table: the enum.
    Table(&'a str),
    /// Scaled: a physical value as `f32`.
    Physical,
}

impl Kind<'_> {
    fn rust(&self) -> &str {
        match self {
            Self::Flag => "bool",
            Self::Integer(name) => name,
            Self::Table(name) => name,
            Self::Physical => "f32",
        }
    }
}

/// A signal as a field of its struct.
struct Field<'a> {
    name: String,
    doc: String,
    kind: Kind<'a>,
    signal: &'a Signal,
}

impl<'a> Field<'a> {
    fn of(dbc: &Dbc, message: &Message, signal: &'a Signal) -> Result<Self> {
        let kind = if dbc
            .value_descriptions_for_signal(message.id, &signal.name)
            .is_some()
        {
            Kind::Table(&signal.name)
        } else if signal.factor != 1.0 || signal.value_type == ValueType::Signed {
            if signal.size > 24 {
                return Err(format!("{}: an f32 has only 24 bits", signal.name).into());
            }
            Kind::Physical
        } else {
            match signal.size {
                1 => Kind::Flag,
                2..=8 => Kind::Integer("u8"),
                9..=16 => Kind::Integer("u16"),
                _ => Kind::Integer("u32"),
            }
        };
        let comment = dbc.signal_comment(message.id, &signal.name);
        let mut doc = comment.map_or(format!("Signal `{}`", signal.name), str::to_owned) + ".";
        let Signal {
            min,
            max,
            factor,
            unit,
            ..
        } = signal;
        match kind {
            Kind::Flag | Kind::Table(_) => {}
            Kind::Integer(_) => write!(doc, " {min} ..= {max} {unit}")?,
            Kind::Physical => write!(doc, " {min} ..= {max} {unit} in steps of {factor}")?,
        }
        Ok(Self {
            name: snake(&signal.name),
            doc,
            kind,
            signal,
        })
    }

    /// Writes the field into `data`.
    fn put(&self) -> String {
        let (constant, name) = (shouted(&self.signal.name), &self.name);
        match self.kind {
            Kind::Physical => format!("{constant}.put_physical(data, self.{name})"),
            Kind::Table(_) => format!("{constant}.put(data, self.{name} as i64)"),
            Kind::Flag | Kind::Integer(_) => {
                format!("{constant}.put(data, i64::from(self.{name}))")
            }
        }
    }

    /// Reads the field from `data`.
    fn get(&self) -> String {
        let signal = format!("Self::{}", shouted(&self.signal.name));
        match self.kind {
            Kind::Physical => format!("{signal}.get_physical(data)?"),
            Kind::Flag => format!("{signal}.get(data)? != 0"),
            Kind::Integer(rust) => format!("{signal}.get(data)? as {rust}"),
            Kind::Table(rust) => {
                format!("{rust}::from_raw({signal}.get(data)?).ok_or({signal}.invalid())?")
            }
        }
    }

    /// The field by its name in the DBC, as a number.
    fn value(&self) -> String {
        let name = &self.name;
        let number = match self.kind {
            Kind::Physical | Kind::Integer(_) => format!("f64::from(self.{name})"),
            Kind::Flag => format!("f64::from(u8::from(self.{name}))"),
            Kind::Table(_) => format!("f64::from(self.{name} as u8)"),
        };
        format!("(\"{}\", {number})", self.signal.name)
    }
}

/// The constants of all signals that are coded.
fn signal_consts(message: &Message) -> Result<String> {
    let coded = |signal: &&Signal| !["Crc", "Counter"].contains(&&*signal.name);
    let line = |signal| {
        let constant = signal_const(message, signal)?;
        Ok(format!("    pub(crate) const {constant}\n"))
    };
    message.signals.iter().filter(coded).map(line).collect()
}

/// The constant that describes a signal to `src/signal.rs`.
fn signal_const(message: &Message, signal: &Signal) -> Result<String> {
    let Signal {
        name,
        start_bit,
        size,
        factor,
        ..
    } = signal;
    if signal.byte_order != ByteOrder::LittleEndian
        || signal.multiplexer_indicator != MultiplexIndicator::Plain
        || signal.offset != 0.0
        || *size > 32
        || start_bit + size > message.size * 8
    {
        return Err(format!(
            "{name}: not a plain little endian signal within the frame, up to 32 bits"
        )
        .into());
    }
    let raw = |physical: &NumericValue| (number(physical) / factor).round() as i64;
    let (min, max) = (raw(&signal.min), raw(&signal.max));
    let held = match signal.value_type {
        ValueType::Unsigned => 0..1 << size,
        ValueType::Signed => -(1 << (size - 1))..1 << (size - 1),
    };
    if !held.contains(&min) || !held.contains(&max) || min > max {
        return Err(format!("{name}: {size} bits do not hold its range").into());
    }
    let name_of_constant = shouted(name);
    Ok(format!(
        "{name_of_constant}: Signal = Signal {{ name: \"{name}\", start: {start_bit}, \
         len: {size}, factor: {factor:?}, min: {min}, max: {max} }};"
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

/// `SteeringAngle` → `steering_angle`, `VX` → `vx`, `XDeviation` → `x_deviation`.
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
