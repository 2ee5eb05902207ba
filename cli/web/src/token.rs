//! The token that the buttons of the page need.

use std::fs::File;
use std::io::Read as _;

use anyhow::Context as _;
use subtle::ConstantTimeEq as _;

/// Random bytes of a token: 128 bits cannot be guessed.
const BYTES: usize = 16;

/// A secret of this start of the program, as hexadecimal text.
#[derive(Clone)]
pub(crate) struct Token(String);

impl Token {
    /// Returns a new token.
    ///
    /// # Errors
    /// If the system gives no random numbers.
    pub(crate) fn new() -> anyhow::Result<Self> {
        let mut bytes = [0; BYTES];
        let mut random = File::open("/dev/urandom").context("/dev/urandom")?;
        random.read_exact(&mut bytes).context("/dev/urandom")?;
        Ok(Self(bytes.map(|byte| format!("{byte:02x}")).concat()))
    }

    /// Returns the token as text.
    pub(crate) fn text(&self) -> &str {
        &self.0
    }

    /// Returns true if `given` is the token. The time that it takes depends only on the length of
    /// `given`, so an attacker who measures it learns nothing about the token.
    pub(crate) fn is(&self, given: &str) -> bool {
        self.0.as_bytes().ct_eq(given.as_bytes()).into()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_token_itself_is_accepted() {
        let token = Token::new().unwrap();
        let other = Token::new().unwrap();
        assert_eq!(token.text().len(), 2 * BYTES);
        assert!(token.is(token.text()));
        for wrong in [
            "",
            other.text(),
            &token.text()[1..],
            &format!("{}0", token.text()),
        ] {
            assert!(!token.is(wrong), "{wrong}");
        }
    }
}
