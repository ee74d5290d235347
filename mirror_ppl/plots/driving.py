def save_sight_picture(data, path):
    pass
