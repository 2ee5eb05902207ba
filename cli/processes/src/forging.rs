//! A foreign node of the bus that forges frames, as a fault of a run asks.

use tandem_board::{CanFrame, CanId, Forgery};
use tandem_bus::Message;

/// The node, and the newest frame in whose name it sends.
#[derive(Debug, Default)]
pub(crate) struct Forging {
    forgery: Option<Forgery>,
    newest: Option<CanFrame>,
}

impl Forging {
    /// Takes what is to be forged. Returns whether anything is.
    pub(crate) fn follow(&mut self, forgery: Option<Forgery>) -> bool {
        if self.forgery != forgery {
            *self = Self {
                forgery,
                newest: None,
            };
        }
        forgery.is_some()
    }

    /// Takes a frame of the bus.
    pub(crate) fn hear(&mut self, frame: &CanFrame) {
        if let (Some(forgery), CanId::Standard(id)) = (self.forgery, frame.id())
            && id == forgery.id
        {
            self.newest = Some(*frame);
        }
    }

    /// Returns the next forged frame; `None` before the first right one.
    pub(crate) fn next(&mut self) -> Option<CanFrame> {
        let Forgery { id, field, value } = self.forgery?;
        let last = self.newest?;
        let mut data = last.data().to_vec();
        Message::forge(id.into(), &mut data, field, value).ok()?;
        let forged = CanFrame::new(last.id(), true, &data).ok()?;
        self.newest = Some(forged);
        Some(forged)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_bus::{EgoMotion, FrameTransmitter};

    /// The node sends the next frame of the sequence with one other signal and a valid protection,
    /// and nothing before it has heard a right one or after the fault.
    #[test]
    fn the_node_goes_on_from_the_newest_frame() {
        let motion = Message::EgoMotion(EgoMotion {
            speed: 20.0,
            ..EgoMotion::default()
        });
        let mut transmitter = FrameTransmitter::new();
        let encoded = transmitter.encode(&motion);
        let id = CanId::Standard(encoded.id);
        let right = CanFrame::new(id, true, encoded.data()).expect("a frame");
        let mut node = Forging::default();
        node.hear(&right);
        assert_eq!(node.next(), None);
        let mut names = vec![];
        motion.values(|name, _| names.push(name));
        let speed = names.iter().position(|name| *name == "Speed");
        let field = u8::try_from(speed.expect("a speed")).expect("few signals");
        let forgery = |field| {
            Some(Forgery {
                id: encoded.id,
                field,
                value: 7.0,
            })
        };
        assert!(node.follow(forgery(field)));
        assert_eq!(node.next(), None, "not before a right frame");
        node.hear(&right);
        for counter in 1..4 {
            let forged = node.next().expect("a forged frame");
            assert_eq!(forged.data()[2], right.data()[2].wrapping_add(counter));
            let message = Message::decode(encoded.id.into(), forged.data());
            let mut values = vec![];
            message
                .expect("valid")
                .values(|name, value| values.push((name, value)));
            let mut expected = vec![];
            motion.values(|name, value| expected.push((name, value)));
            expected[usize::from(field)].1 = 7.0;
            assert_eq!(values.len(), expected.len());
            for (is, due) in values.iter().zip(&expected) {
                assert!((is.1 - due.1).abs() < 0.05, "{is:?} {due:?}");
            }
        }
        assert!(!node.follow(None));
        node.hear(&right);
        assert_eq!(node.next(), None);
    }
}
