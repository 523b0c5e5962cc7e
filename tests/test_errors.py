"""Words of messages."""

from sysid.errors import MOST_LISTED, listed


def test_a_list_in_a_message_is_whole_or_tells_how_many_more_there_are():
    words = [f"k[{i}]" for i in range(MOST_LISTED + 3)]
    assert listed(words[:2]) == "k[0], k[1]"
    assert listed(words[:MOST_LISTED], "; ").split("; ") == words[:MOST_LISTED]
    shown, more = listed(words, ",").split(" and ")
    assert shown.split(",") == words[:MOST_LISTED] and more == "3 more"
    assert listed([]) == ""
