//! The listing of a domain reads what others announce: any bytes.

use proptest::prelude::*;
use tandem_topics::GuidPrefix;
use tandem_topics_host::listing::Listing;

/// The head of a message of vendor 1.16, and a DATA of the writer of announcements of readers.
const HEAD: [u8; 44] = [
    b'R', b'T', b'P', b'S', 2, 3, 1, 16, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, // head
    0x15, 5, 0, 0, 0, 0, 16, 0, 0, 0, 4, 0xC7, 0, 0, 4, 0xC2, 0, 0, 0, 0, 1, 0, 0, 0, // DATA
];
/// A list of parameters: the name of an endpoint, its topic and type, and that it is reliable.
const LIST: [u8; 76] = [
    0, 3, 0, 0, 0x5A, 0, 16, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 0, 0, 1, 4, // name
    5, 0, 12, 0, 6, 0, 0, 0, b't', b'o', b'p', b'i', b'c', 0, 0, 0, // topic
    7, 0, 12, 0, 5, 0, 0, 0, b't', b'y', b'p', b'e', 0, 0, 0, 0, // type
    0x1A, 0, 12, 0, 2, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, // reliability
    1, 0, 0, 0, // end
];

const OWN: GuidPrefix = GuidPrefix([0; 12]);

#[test]
fn an_announcement_is_listed() {
    let mut listing = Listing::default();
    let datagram = [&HEAD[..], &LIST].concat();
    listing.hear(OWN, &datagram);
    let endpoints = listing.endpoints();
    let [endpoint] = endpoints[..] else {
        panic!("{endpoints:?}");
    };
    assert!(!endpoint.writes && endpoint.topic == "topic" && endpoint.type_name == "type");
    assert_eq!(endpoint.quality(), "reliable, volatile");
    assert_eq!(endpoint.from, "cyclone-05060708");
    // One's own are not listed.
    let mut listing = Listing::default();
    let own = std::array::from_fn(|index| index as u8 + 1);
    listing.hear(GuidPrefix(own), &datagram);
    assert!(listing.endpoints().is_empty());
}

proptest! {
    /// Nothing that arrives causes a panic.
    #[test]
    fn any_bytes_are_read(
        changes in prop::collection::vec((0..HEAD.len() + LIST.len(), any::<u8>()), 0..8),
        length in 0..=HEAD.len() + LIST.len(),
        more in prop::collection::vec(any::<u8>(), 0..64),
    ) {
        let mut datagram = [&HEAD[..], &LIST].concat();
        for (place, byte) in changes {
            datagram[place] = byte;
        }
        datagram.truncate(length);
        datagram.extend(more);
        let mut listing = Listing::default();
        listing.hear(OWN, &datagram);
        for endpoint in listing.endpoints() {
            let _words = (endpoint.quality(), listing.misfits(endpoint));
        }
    }
}
