//! Fuzz target for messages of gPTP: a conversation with a slave.

use tandem_board::{Duration, Instant};
use tandem_timesync::gptp::{EventId, PortIdentity, PtpProfile, Slave, SlaveSettings, TimeOutlet};
use tandem_timesync::{Arbitrary, Sample};

const SLAVE: PortIdentity = PortIdentity::from_mac([0, 0x1B, 0x19, 0, 0, 9]);
/// A message leaves this long after it was given to be sent.
const LEAVES_AFTER: Duration = Duration::from_us(1);

/// Asserts that each message that leaves is one that a slave may send.
struct Sent {
    profile: PtpProfile,
    events: Vec<EventId>,
}

impl TimeOutlet for Sent {
    fn send(&mut self, message: &[u8], event: Option<EventId>) {
        let kind = message[0] & 0xF;
        assert!([0x1, 0x2, 0x3, 0xA].contains(&kind), "{message:?}");
        assert_eq!(message[0] >> 4, self.profile.sdo);
        assert_eq!(usize::from(message[3]), message.len());
        assert_eq!(message[20..28], SLAVE.clock.0);
        assert_eq!(
            (event, event.is_some()),
            (EventId::of(message), kind != 0xA)
        );
        self.events.extend(event);
    }
}

/// Takes the profile and then messages, each with its length and the milliseconds before it.
/// Returns whether a sample came of them.
///
/// # Panics
/// If local times of samples do not rise, a sample is from the future, or what the slave sends is
/// not a message of a slave.
pub(crate) fn gptp(bytes: &[u8]) -> bool {
    let Some((profile, mut rest)) = bytes.split_first() else {
        return false;
    };
    let profile = match profile & 1 {
        0 => PtpProfile::GPTP,
        _ => PtpProfile::END_TO_END,
    };
    let mut slave = Slave::<Arbitrary>::new(SlaveSettings::new(SLAVE, profile));
    let mut now = Instant::from_ns(1_000_000_000);
    let mut last: Option<Sample<Arbitrary>> = None;
    while let Some((&[len, high, low], content)) = rest.split_first_chunk() {
        let (message, next) = content
            .split_at_checked(len.into())
            .unwrap_or((content, &[]));
        rest = next;
        now += Duration::from_ms(u16::from_be_bytes([high, low]).into());
        let events = Vec::new();
        let mut sent = Sent { profile, events };
        assert!(slave.poll(now, &mut sent) > now);
        let sample = slave.on_message(now, message, &mut sent);
        while let Some(event) = sent.events.pop() {
            slave.on_sent(event, now + LEAVES_AFTER, &mut sent);
        }
        if let Some(sample) = sample {
            assert!(sample.local <= now && slave.status().why.is_none());
            assert!(last.is_none_or(|last| last.local < sample.local));
            last = Some(sample);
        }
    }
    last.is_some()
}
