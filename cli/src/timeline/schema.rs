//! The part of Perfetto's trace format that this program writes, in protobuf's wire format.
//!
//! Numbers and types of the fields are those of `protos/perfetto/trace/perfetto_trace.proto` of
//! the Perfetto project. The test `perfetto_oracle` decodes a trace with Perfetto's description.

/// Field of a trace: a packet.
pub(super) const PACKET: u32 = 1;

/// Fields of a packet of a trace.
pub(super) mod packet {
    /// Time, ns.
    pub(crate) const TIMESTAMP: u32 = 8;
    pub(crate) const SEQUENCE_ID: u32 = 10;
    pub(crate) const TRACK_EVENT: u32 = 11;
    pub(crate) const INTERNED_DATA: u32 = 12;
    pub(crate) const SEQUENCE_FLAGS: u32 = 13;
    pub(crate) const TRACK_DESCRIPTOR: u32 = 60;
}

/// Flag of a sequence: this packet clears all earlier names.
pub(super) const STATE_CLEARED: u64 = 1;
/// Flag of a packet: it uses names that its sequence defined.
pub(super) const NEEDS_STATE: u64 = 2;

/// Fields of a row of the view.
pub(super) mod track {
    pub(crate) const UUID: u32 = 1;
    pub(crate) const NAME: u32 = 2;
    /// With the fields of [`process`].
    pub(crate) const PROCESS: u32 = 3;
    /// With the fields of [`thread`].
    pub(crate) const THREAD: u32 = 4;
    pub(crate) const PARENT_UUID: u32 = 5;
    /// With the field [`UNIT_NAME`].
    pub(crate) const COUNTER: u32 = 8;
    pub(crate) const UNIT_NAME: u32 = 6;

    pub(crate) mod process {
        pub(crate) const PID: u32 = 1;
        pub(crate) const NAME: u32 = 6;
    }

    pub(crate) mod thread {
        pub(crate) const PID: u32 = 1;
        pub(crate) const TID: u32 = 2;
        pub(crate) const NAME: u32 = 5;
    }
}

/// Fields of an event on a row.
pub(super) mod event {
    pub(crate) const CATEGORY: u32 = 3;
    /// A figure attached to the event: [`FIGURE_NAME`] and [`FIGURE_VALUE`].
    pub(crate) const FIGURE: u32 = 4;
    pub(crate) const TYPE: u32 = 9;
    pub(crate) const NAME: u32 = 10;
    pub(crate) const TRACK: u32 = 11;
    pub(crate) const COUNTER_VALUE: u32 = 44;
    pub(crate) const FLOW: u32 = 47;
    pub(crate) const TERMINATING_FLOW: u32 = 48;

    pub(crate) const FIGURE_NAME: u32 = 1;
    pub(crate) const FIGURE_VALUE: u32 = 5;
}

/// Values of [`event::TYPE`].
pub(super) mod event_type {
    pub(crate) const SLICE_BEGIN: u64 = 1;
    pub(crate) const SLICE_END: u64 = 2;
    pub(crate) const INSTANT: u64 = 3;
    pub(crate) const COUNTER: u64 = 4;
}

/// Fields of the names that packets refer to by number.
pub(super) mod names {
    pub(crate) const CATEGORY: u32 = 1;
    pub(crate) const EVENT: u32 = 2;
    pub(crate) const FIGURE: u32 = 3;

    pub(crate) const NUMBER: u32 = 1;
    pub(crate) const NAME: u32 = 2;
}

/// A message, made field by field in any order.
#[derive(Debug, Default)]
pub(super) struct Message {
    bytes: Vec<u8>,
}

impl Message {
    const VARINT: u64 = 0;
    const FIXED64: u64 = 1;
    const LENGTH_DELIMITED: u64 = 2;

    /// Adds a number: `uint64`, `uint32`, or a value of `int32` or `int64` that is not negative.
    pub(super) fn number(&mut self, field: u32, value: u64) -> &mut Self {
        self.key(field, Self::VARINT);
        self.varint(value);
        self
    }

    /// Adds a `fixed64`.
    pub(super) fn fixed(&mut self, field: u32, value: u64) -> &mut Self {
        self.key(field, Self::FIXED64);
        self.bytes.extend(value.to_le_bytes());
        self
    }

    /// Adds a `double`.
    pub(super) fn double(&mut self, field: u32, value: f64) -> &mut Self {
        self.fixed(field, value.to_bits())
    }

    /// Adds a `string`.
    pub(super) fn text(&mut self, field: u32, text: &str) -> &mut Self {
        self.delimited(field, text.as_bytes())
    }

    /// Adds another message.
    pub(super) fn message(&mut self, field: u32, message: &Self) -> &mut Self {
        self.delimited(field, &message.bytes)
    }

    /// The encoded message.
    pub(super) fn into_bytes(self) -> Vec<u8> {
        self.bytes
    }

    fn delimited(&mut self, field: u32, bytes: &[u8]) -> &mut Self {
        self.key(field, Self::LENGTH_DELIMITED);
        self.varint(bytes.len() as u64);
        self.bytes.extend(bytes);
        self
    }

    fn key(&mut self, field: u32, kind: u64) {
        self.varint(u64::from(field) << 3 | kind);
    }

    /// Seven bits a byte, lowest first; the top bit says that more follow.
    fn varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.bytes.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.bytes.push(value as u8);
    }
}
